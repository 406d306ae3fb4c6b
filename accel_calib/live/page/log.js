// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// The log of the session. Each line has a number, so that none is missing or twice after a loss of
// the connection.

import { withButtons } from './words.js';

const MOST = 500;

export class LogView {
  #list;
  #latest;
  /** Number of the last line that is shown. */
  seen = 0;

  constructor(details) {
    this.#list = details.querySelector('ol');
    this.#latest = details.querySelector('#latest');
  }

  add({ number, severity, words, time }) {
    if (number <= this.seen) return;
    this.seen = number;
    const line = document.createElement('li');
    line.dataset.severity = severity;
    line.dataset.number = number;
    const at = document.createElement('time');
    at.textContent = new Date(1000 * time).toLocaleTimeString([], { hour12: false });
    const readable = withButtons(words);
    const what = severity === 'info' ? '' : `${severity}: `;
    line.append(at, ` ${what}${readable}`);
    this.#list.prepend(line);
    while (this.#list.children.length > MOST) this.#list.lastChild.remove();
    this.#latest.textContent = readable;
    this.#latest.dataset.severity = severity;
  }
}
