// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// What the drawings share: a canvas with sharp pixels, the colours of the style sheet, and a label
// for screen readers that does not change too often.

const LABEL_EVERY = 2000;  // [ms]

const dark = matchMedia('(prefers-color-scheme: dark)');
let colours = {};

/** Return the colour of this name in the style sheet. */
export function colour(name) {
  colours[name] ??= getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  return colours[name];
}

/** Call a function when the colours have changed. */
export function onColours(draw) {
  dark.addEventListener('change', () => {
    colours = {};
    draw();
  });
}

/** Clear a canvas; return its context and its size in CSS pixels. */
export function cleared(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 3);
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const [wide, high] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== wide || canvas.height !== high) [canvas.width, canvas.height] = [wide, high];
  const context = canvas.getContext('2d');
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

export const element = (id) => document.getElementById(id);

const waiting = new Map();

/** Set the label of a drawing, at most every 2 s; the last of several is used. */
export function label(drawing, words) {
  if (waiting.has(drawing)) {
    waiting.set(drawing, words);
    return;
  }
  if (drawing.getAttribute('aria-label') === words) return;
  drawing.setAttribute('aria-label', words);
  waiting.set(drawing, null);
  setTimeout(() => {
    const next = waiting.get(drawing);
    waiting.delete(drawing);
    if (next !== null) label(drawing, next);
  }, LABEL_EVERY);
}

/** Set the text of a node if it differs. */
export function text(node, words) {
  if (node.textContent !== words) node.textContent = words;
}
