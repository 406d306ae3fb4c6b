// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// The screen stays on while the page is visible and connected. Browsers permit this only on pages
// of the same machine, or with https; elsewhere the screen may go off, and nothing is lost.

export class Awake {
  #lock = null;
  #wanted = false;
  #asking = false;

  constructor() {
    document.addEventListener('visibilitychange', () => this.#update());
  }

  /** Keep the screen on, or no longer. */
  keep(wanted) {
    this.#wanted = wanted;
    this.#update();
  }

  async #update() {
    if (!this.#wanted) {
      this.#lock?.release();
      this.#lock = null;
      return;
    }
    const has = this.#lock !== null && !this.#lock.released;
    if (!navigator.wakeLock || document.hidden || has || this.#asking) return;
    this.#asking = true;
    try {
      this.#lock = await navigator.wakeLock.request('screen');
    } catch (error) {
      if (error.name !== 'NotAllowedError') throw error;  // the battery is low, for example
    } finally {
      this.#asking = false;
    }
    if (!this.#wanted) this.#update();
  }
}
