// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// window.show(words…) labels a drawing, and adds its label to window.found.
async () => {
  const { label } = await import('/page/canvas.js');
  const drawing = document.createElement('canvas');
  window.found = [];
  window.show = (...all) => {
    for (const words of all) label(drawing, words);
    window.found.push(drawing.getAttribute('aria-label'));
  };
  window.show('first', 'second', 'third');
}
