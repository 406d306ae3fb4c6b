// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// A sound and a vibration for each captured pose, and the switch for them. Browsers allow sound
// only after the first tap or key.

const KEY = 'accel_calib sound';
const NOTES = [[880, 0], [1320, 0.12]];  // frequency [Hz], start [s]

let audio = null;

export class Sound {
  #button;
  #on = localStorage.getItem(KEY) !== 'off';

  constructor(button) {
    this.#button = button;
    this.#show();
    button.addEventListener('click', () => {
      this.#on = !this.#on;
      localStorage.setItem(KEY, this.#on ? 'on' : 'off');
      this.#show();
      if (this.#on) play();
    });
    for (const name of ['pointerdown', 'keydown']) addEventListener(name, allow);
  }

  captured() {
    if (!this.#on) return;
    play();
    if (navigator.userActivation?.hasBeenActive) navigator.vibrate?.(120);
  }

  #show() {
    this.#button.setAttribute('aria-pressed', `${this.#on}`);
  }
}

function allow() {
  audio ??= new AudioContext();
  if (audio.state === 'suspended') audio.resume();
}

function play() {
  if (audio?.state !== 'running') return;
  for (const [frequency, after] of NOTES) {
    const start = audio.currentTime + after;
    const tone = new OscillatorNode(audio, { frequency });
    const volume = new GainNode(audio, { gain: 0 });
    volume.gain.setValueAtTime(0, start);
    volume.gain.linearRampToValueAtTime(0.3, start + 0.01);
    volume.gain.exponentialRampToValueAtTime(0.001, start + 0.25);
    tone.connect(volume).connect(audio.destination);
    tone.start(start);
    tone.stop(start + 0.26);
  }
}
