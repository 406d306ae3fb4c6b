// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// The buttons: they send commands and show the answers in their own words.

import { token } from './connection.js';
import { buttonOf, withButtons } from './words.js';

const element = (id) => document.getElementById(id);

export class Commands {
  #connection;
  #announce;
  #buttons = [...document.querySelectorAll('[data-command]')];
  #answer = element('answer');
  #may = false;
  #why = 'there is no connection to the calibrator';
  #busy = '';

  constructor(connection, announce) {
    [this.#connection, this.#announce] = [connection, announce];
    for (const button of this.#buttons) {
      button.addEventListener('click', () => this.#ask(button.dataset.command));
    }
    this.#answer.querySelector('button').addEventListener('click', () => this.#dismiss());
    element('reset').addEventListener('click', () => this.#open('reset-dialog'));
    element('reset-dialog').addEventListener('close', (event) => {
      if (event.target.returnValue === 'reset') this.#ask('reset');
      event.target.returnValue = '';
    });
    element('export').addEventListener('click', () => this.#open('export-dialog'));
    this.#mark();
  }

  /** Set whether commands are accepted, and why not. */
  allow(may, why) {
    [this.#may, this.#why] = [may, why];
    this.#mark();
  }

  /** Set the name of the command that runs; empty: none. */
  setBusy(busy) {
    this.#busy = busy;
    this.#mark();
  }

  /** Set the names of the formats of the export. */
  setFormats(names) {
    element('formats').replaceChildren(...names.map((name) => {
      const button = document.createElement('button');
      [button.type, button.textContent] = ['button', name];
      button.addEventListener('click', () => this.#export(name));
      const item = document.createElement('li');
      item.append(button);
      return item;
    }));
  }

  show({ success, words }) {
    this.#answer.dataset.success = `${success}`;
    const readable = withButtons(words);
    this.#answer.querySelector('p').textContent = readable;
    this.#answer.hidden = false;
    this.#announce(readable);
  }

  async #ask(command) {
    if (this.#refuse()) return;
    this.show(await this.#connection.ask(command));
  }

  #refuse() {
    const words = !this.#may ? this.#why
      : this.#busy ? `${buttonOf(this.#busy)} is still running: wait until it ends` : '';
    if (words) this.show({ success: false, words });
    return words !== '';
  }

  #open(id) {
    if (!this.#refuse()) element(id).showModal();
  }

  #dismiss() {
    this.#answer.hidden = true;
    element('commands').focus();
  }

  /** Buttons that do nothing now stay in the order of the keyboard, and say why. */
  #mark() {
    const disabled = `${!this.#may || this.#busy !== ''}`;
    for (const button of [...this.#buttons, element('reset'), element('export')]) {
      button.setAttribute('aria-disabled', disabled);
      button.classList.toggle('runs', button.dataset.command === this.#busy);
    }
  }

  async #export(name) {
    element('export-dialog').close();
    try {
      const response = await fetch(`/export/${encodeURIComponent(name)}`, {
        headers: { Authorization: `Bearer ${token()}` } });
      if (!response.ok) {
        this.show({ success: false, words: (await response.text()).slice(0, 500) });
        return;
      }
      const file = nameOf(response) || `calibration.${name}`;
      save(await response.blob(), file);
      this.show({ success: true, words: `${file} is downloaded` });
    } catch (error) {
      this.show({ success: false, words: `the export failed: ${error.message}` });
    }
  }
}

function nameOf(response) {
  const found = /filename="?([\w.-]+)"?/.exec(response.headers.get('Content-Disposition') ?? '');
  return found ? found[1] : '';
}

function save(blob, file) {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(blob);
  link.download = file;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
