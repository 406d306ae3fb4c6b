// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// Note in window.seen how the button of refine is blocked and released.
() => {
  const button = document.querySelector('[data-command=refine]');
  window.seen = [];
  new MutationObserver(() => window.seen.push(button.getAttribute('aria-disabled')))
    .observe(button, { attributeFilter: ['aria-disabled'] });
}
