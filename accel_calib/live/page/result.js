// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// The result: the verdict, the numbers, and the calibration page in a frame.

import { element, text } from './canvas.js';
import { figure, fixed, withButtons } from './words.js';

const joined = (values, decimals) => values.map((value) => fixed(value, decimals)).join('  ');

/** Name, key in the message, and text of each number. */
const FIGURES = [
  ['poses used', 'poses', (count, { left_out: out }) => (out ? `${count} of ${count + out}` : count)],
  ['coverage', 'coverage', (share) => (share === null ? '–' : `${Math.round(100 * share)} %`)],
  ['offset x, y, z', 'offset', (offset, { unit }) => `${joined(offset, 4)} ${unit}`],
  ['gain x, y, z', 'gain', (gain) => joined(gain, 4)],
  ['effects', 'effects', (names) => names.map((name) => name.replaceAll('_', ' ')).join(', ')],
];

export class Result {
  #section = element('result');
  #report = element('report');
  #frame = this.#report.querySelector('iframe');
  #page = '';

  constructor() {
    this.#report.addEventListener('toggle', () => this.#load());
  }

  show({ rating, result, page, preview }) {
    this.#section.hidden = !rating && !result && !page;
    text(element('result-title'), preview ? 'New calibration, not in use yet' : 'Calibration in use');
    this.#showVerdict(rating);
    showFigures(result ?? {});
    element('warnings').replaceChildren(
      ...(result?.warnings ?? []).map((words) => made('li', withButtons(words))));
    this.#page = page;
    this.#report.hidden = this.#page === '';
    this.#load();
  }

  #showVerdict(rating) {
    const box = element('verdict');
    box.hidden = !rating;
    if (!rating) return;
    const [name, reason] = box.children;
    box.dataset.rating = rating.rating;
    text(name, rating.rating);
    text(reason, withButtons(rating.reason));
  }

  /** Load the page only when it is looked at, because drawing its maps takes time. */
  #load() {
    if (!this.#report.open || this.#page === '' || this.#page === this.#frame.dataset.page) return;
    this.#frame.dataset.page = this.#page;
    this.#frame.src = this.#page;
  }
}

function showFigures(result) {
  const residuals = (result.residuals ?? []).map(([label, value, unit]) => (
    [label, value === null ? '–' : `${figure(value)} ${unit}`]));
  const others = FIGURES.filter(([, key]) => result[key] !== undefined)
    .map(([name, key, write]) => [name, write(result[key], result)]);
  element('figures').replaceChildren(...[...residuals, ...others].map(([name, words]) => {
    const row = document.createElement('div');
    row.append(made('dt', name), made('dd', words));
    return row;
  }));
}

function made(tag, words) {
  const node = document.createElement(tag);
  node.textContent = words;
  return node;
}
