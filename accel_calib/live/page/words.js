// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// Words and numbers as the page shows them.

import { unit } from './geometry.js';

/** Names of the sides of the sensor: along +x and -x, +y and -y, +z and -z. */
export const SIDES = [['front', 'back'], ['left', 'right'], ['top', 'bottom']];

const WHAT = ['', 'side', 'edge', 'corner'];
const NEAR = 0.38;  // half way between a side (0) and an edge (0.71), about

/** Labels of the buttons by command; of two for one command, the first one. */
const BUTTONS = Object.fromEntries(
  [...document.querySelectorAll('[data-command], #reset, #export')].reverse()
    .map((button) => [button.dataset.command ?? button.id, button.textContent.replace(' …', '')]));

/** Return the side, edge or corner nearest to a direction, such as “left side”. */
export function sideOf(direction) {
  const parts = unit(direction);
  const names = SIDES.map((pair, k) => (Math.abs(parts[k]) > NEAR ? pair[parts[k] > 0 ? 0 : 1] : ''))
    .filter(Boolean);
  return `${names.join(' ')} ${WHAT[names.length]}`;
}

/** Return a text with the names of buttons instead of services, and with true minus signs. */
export function withButtons(words) {
  return words.replace(/ -([xyz])/g, ' −$1').replace(/\(-([xyz])/g, '(−$1')
    .replace(/call ~\/(\w+)/g, (all, name) => (name in BUTTONS ? `press ${BUTTONS[name]}` : all))
    .replace(/~\/(\w+)/g, (all, name) => (name === 'preview' ? 'the preview'
      : name in BUTTONS ? BUTTONS[name] : all));
}

/** Return the label of the button of a command. */
export const buttonOf = (command) => BUTTONS[command] ?? command.replaceAll('_', ' ');

export const capitalised = (words) => words.charAt(0).toUpperCase() + words.slice(1);

/** Return a number with 2 significant digits, without exponent. */
export function figure(value) {
  const size = Math.abs(value);
  if (size >= 100 || size === 0) return value.toFixed(0);
  return value.toFixed(Math.max(0, Math.min(6, 1 - Math.floor(Math.log10(size)))))
    .replace('-', '−');
}

/** Return a number with this many decimals; a dash if it is not known. */
export function fixed(value, decimals, unitName = '') {
  if (value === null) return '–';
  return value.toFixed(decimals).replace('-', '−') + unitName;
}

/** Return the number of poses, with the number expected in the end. */
export const countOf = (poses, total) => (
  poses >= total ? `${poses}` : `${poses} of about ${total}`);
