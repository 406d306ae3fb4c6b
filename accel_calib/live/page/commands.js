// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// The buttons: they send commands and show the answers in their own words.

import { element } from './canvas.js';
import { token } from './connection.js';
import { buttonOf, withButtons } from './words.js';

const SHOWN = 10000;  // time for which the answer of a command that succeeded is shown [ms]
const MOVED = ['set_level', 'calibrate_at_rest', 'refine'];  // the last one comes first

const buttonFor = (command) => document.querySelector(`#commands [data-command=${command}]`);

export class Commands {
  #connection;
  #announce;
  #buttons = [...document.querySelectorAll('[data-command]')];
  #answer = element('answer');
  #offer = element('offer');
  #heading = element('more-commands').querySelector('[data-command=set_heading]');
  #next = '';
  #timer = 0;
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

  /** Set whether a calibration is offered, and its rating; the focus stays near its buttons. */
  setOffer(offered, rating) {
    this.#offer.dataset.rating = rating?.rating ?? '';
    const hadFocus = this.#offer.contains(document.activeElement);
    if (offered) this.hideSuccess();  // the offer says the same, and more
    this.#offer.hidden = !offered;
    if (hadFocus && !offered) element('commands').focus({ preventScroll: true });
  }

  /** Set whether the mounting is levelled; its heading is set after that. */
  setLevelled(levelled) {
    this.#heading.hidden = !levelled;
  }

  /** Emphasise the button of the next command; on a phone it comes to the bottom. */
  setNext(command) {
    if (command === this.#next) return;
    this.#next = command;
    const focused = document.activeElement;
    for (const button of MOVED.map(buttonFor)) {
      element(button.dataset.command === command ? 'main-commands' : 'more-commands')
        .prepend(button);
    }
    buttonFor('calibrate_at_rest').hidden = command !== 'calibrate_at_rest';
    for (const button of this.#buttons) {  // Save is Accept while a calibration is offered
      button.classList.toggle('primary', button.dataset.command === command
        && button.parentElement.id !== 'more-commands');
    }
    if (document.activeElement !== focused) focused.focus({ preventScroll: true });
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

  /** Hide the answer of a command that succeeded; the log keeps it. */
  hideSuccess() {
    if (this.#answer.dataset.success === 'true') this.#answer.hidden = true;
  }

  /** Show an answer, and read it to users of screen readers. */
  show({ success, words }) {
    this.#answer.dataset.success = `${success}`;
    const readable = withButtons(words);
    this.#answer.querySelector('p').textContent = readable;
    this.#answer.hidden = success && !this.#offer.hidden;  // what is offered is the answer
    this.#announce(readable);
    clearTimeout(this.#timer);
    if (success) this.#timer = setTimeout(() => this.hideSuccess(), SHOWN);
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
