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

const waiting = new Map();

/** Set the label of an element, at most every 2 s; the last of several is used. */
export function label(element, words) {
  const known = waiting.get(element);
  if (known !== undefined) {
    waiting.set(element, words);
    return;
  }
  if (element.getAttribute('aria-label') === words) return;
  element.setAttribute('aria-label', words);
  waiting.set(element, null);
  setTimeout(() => {
    const next = waiting.get(element);
    waiting.delete(element);
    if (next !== null) label(element, next);
  }, LABEL_EVERY);
}

/** Set the text of an element if it differs. */
export function text(element, words) {
  if (element.textContent !== words) element.textContent = words;
}
