// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// The connection to the calibrator: it returns after every loss, and asks for what was missed.

const WAITS = [0.25, 0.5, 1, 2, 4, 5];  // before the next attempts [s]
const SILENT = 4000;  // a connection without messages for longer is lost [ms]
const STALE = 1500;  // the same after the page was asleep [ms]
const TOKEN = 'accel_calib token';

export class Connection {
  #socket = null;
  #attempts = 0;
  #timer = 0;
  #heard = 0;
  #asked = 0;
  #answers = new Map();
  #on;

  /**
   * `on.message(message)` gets each message, `on.state(name)` each of connecting, open, lost, and
   * `on.seen()` returns the number of the last log line.
   */
  constructor(on) {
    this.#on = on;
    takeToken();
    addEventListener('hashchange', () => takeToken() && this.#connect());
    addEventListener('online', () => this.#wake());
    addEventListener('offline', () => this.#lose());
    addEventListener('pageshow', (event) => event.persisted && this.#wake());
    document.addEventListener('visibilitychange', () => !document.hidden && this.#wake());
    setInterval(() => this.#check(), 1000);
    on.state('connecting');
    this.#connect();
  }

  /** Send a command; return the promise of its answer, {success, words}. */
  ask(command) {
    if (this.#socket?.readyState !== WebSocket.OPEN) {
      return Promise.resolve({
        success: false, words: 'there is no connection to the calibrator: wait until it is back' });
    }
    this.#asked += 1;
    this.#socket.send(JSON.stringify({ ask: { id: this.#asked, command } }));
    return new Promise((resolve) => { this.#answers.set(this.#asked, resolve); });
  }

  #connect() {
    clearTimeout(this.#timer);
    this.#drop();
    const scheme = location.protocol === 'https:' ? 'wss:' : 'ws:';
    const socket = new WebSocket(`${scheme}//${location.host}/stream`);
    this.#socket = socket;
    this.#heard = performance.now();
    socket.onopen = () => socket.send(
      JSON.stringify({ hello: { token: token(), seen: this.#on.seen() } }));
    socket.onmessage = (event) => this.#take(JSON.parse(event.data));
    socket.onclose = () => this.#lose();
  }

  #take(message) {
    this.#heard = performance.now();
    if (message.kind === 'welcome') {
      this.#attempts = 0;
      this.#on.state('open');
    }
    if (message.kind === 'answer') {
      this.#answers.get(message.id)?.(message);
      this.#answers.delete(message.id);
    } else {
      this.#on.message(message);
    }
  }

  /** Forget the socket, and try again later. */
  #lose() {
    this.#drop();
    this.#on.state('lost');
    clearTimeout(this.#timer);
    const wait = WAITS[Math.min(this.#attempts, WAITS.length - 1)];
    this.#attempts += 1;
    this.#timer = setTimeout(() => this.#connect(), 1000 * wait);
  }

  #drop() {
    if (this.#socket) {
      this.#socket.onopen = this.#socket.onmessage = this.#socket.onclose = null;
      this.#socket.close();
      this.#socket = null;
    }
    for (const resolve of this.#answers.values()) {
      resolve({ success: false, words: 'the connection was lost before the answer: see the log' });
    }
    this.#answers.clear();
  }

  /** Lose a connection that is open but silent, as after a sleep of the other side. */
  #check() {
    if (this.#socket && performance.now() - this.#heard > SILENT) this.#lose();
  }

  /** Connect at once, unless the connection works. */
  #wake() {
    const works = this.#socket?.readyState === WebSocket.OPEN
      && performance.now() - this.#heard < STALE;
    if (works) return;
    this.#attempts = 0;
    this.#on.state('connecting');
    this.#connect();
  }
}

/** Return the token of this tab; empty if there is none. */
export const token = () => sessionStorage.getItem(TOKEN) ?? '';

/** Keep the token of the link for this tab, and remove it from the address bar. */
function takeToken() {
  const found = location.hash.slice(1);
  if (!found || document.getElementById(found)) return false;  // the link to the commands
  sessionStorage.setItem(TOKEN, found);
  history.replaceState(null, '', location.pathname);
  return true;
}
