// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// The next action as speech, for a user who looks at the sensor. A voice of the device speaks, and
// never one of the network. Browsers speak only after the first tap or key.

const KEY = 'accel_calib speech';

export class Speech {
  #button;
  #fail;
  #voices = window.speechSynthesis;
  #on = localStorage.getItem(KEY) === 'on';

  /** `fail(words)` shows why the browser does not speak. */
  constructor(button, fail) {
    [this.#button, this.#fail] = [button, fail];
    button.hidden = !this.#voices;
    this.#show();
    button.addEventListener('click', () => {
      this.#switch(!this.#on);
      if (this.#on) this.say('Speech is on.');
      else this.#voices.cancel();
    });
  }

  /** Speak these words instead of those before. */
  say(words) {
    if (!this.#on || !this.#voices) return;
    this.#voices.cancel();
    const spoken = new SpeechSynthesisUtterance(words);
    spoken.lang = 'en-US';
    spoken.voice = this.#voices.getVoices()
      .find(({ lang, localService }) => localService && lang.startsWith('en')) ?? null;
    spoken.onerror = ({ error }) => this.#onError(error);
    this.#voices.speak(spoken);
  }

  #onError(error) {
    // Newer words replace older ones, and speech waits for the first tap after a reload.
    if (['canceled', 'interrupted', 'not-allowed'].includes(error)) return;
    this.#switch(false);
    this.#fail(`this browser does not speak (${error}): install a voice, or use another browser`);
  }

  #switch(on) {
    this.#on = on;
    localStorage.setItem(KEY, on ? 'on' : 'off');
    this.#show();
  }

  #show() {
    this.#button.setAttribute('aria-pressed', `${this.#on}`);
  }
}
