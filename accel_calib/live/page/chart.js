// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// Raw and corrected |a| − 1 g of the last 60 s. The range follows the readings at rest: the few
// readings of a turn may leave it.

import { cleared, colour, label } from './canvas.js';
import { fixed } from './words.js';

const SECONDS = 60;
const EVERY = 100;  // shortest time between two drawings [ms]
const LEAST = 10;  // half the smallest range [mg]
const OUTSIDE = 0.08;  // share of the readings at each end that may leave the range
const GAP = 0.5;  // a longer time without readings interrupts the line [s]
const MARGIN = { left: 44, right: 10, top: 10, bottom: 26 };

export class Chart {
  #canvas;
  #rows = [];  // [time, raw, corrected], in mg; null: not known
  #drawn = -Infinity;
  #dirty = true;

  constructor(canvas) {
    this.#canvas = canvas;
  }

  /** Replace all readings by a history of columns. */
  setHistory({ time, length, corrected }) {
    this.#rows = [];
    time.forEach((at, k) => this.add(at, length[k], corrected[k]));
  }

  /** Add |a| of the newest message [g]. */
  add(time, raw, corrected) {
    const last = this.#rows.at(-1);
    if (last && time === last[0]) return;
    if (last && time < last[0]) this.#rows = [];  // a recording that starts again
    this.#rows.push([time, inMg(raw), inMg(corrected)]);
    const first = this.#rows.findIndex(([at]) => at >= time - SECONDS);
    if (first > 0) this.#rows.splice(0, first);
    this.#dirty = true;
  }

  redraw() {
    [this.#dirty, this.#drawn] = [true, -Infinity];
  }

  draw(now) {
    if (!this.#dirty || now - this.#drawn < EVERY) return;
    [this.#dirty, this.#drawn] = [false, now];
    const { context, width, height } = cleared(this.#canvas);
    if (width === 0) return;
    const [low, high, step] = this.#range();
    const newest = this.#rows.length ? this.#rows.at(-1)[0] : 0;
    const wide = width - MARGIN.left - MARGIN.right;
    const high2 = height - MARGIN.top - MARGIN.bottom;
    const x = (time) => MARGIN.left + wide * (1 + (time - newest) / SECONDS);
    const y = (mg) => MARGIN.top + high2 * (high - mg) / (high - low);
    drawAxes(context, { low, high, step, newest, x, y, width, height });
    context.save();
    context.beginPath();
    context.rect(MARGIN.left, MARGIN.top, wide, high2);
    context.clip();
    this.#line(context, 1, colour('before'), x, y);
    this.#line(context, 2, colour('after'), x, y);
    context.restore();
    this.#describe();
  }

  #range() {
    const values = this.#rows.flatMap(([, raw, corrected]) => [raw, corrected])
      .filter((value) => value !== null).sort((a, b) => a - b);
    const at = (share) => values[Math.round(share * (values.length - 1))] ?? 0;
    const [least, most] = [at(OUTSIDE), at(1 - OUTSIDE)];
    const middle = (least + most) / 2;
    const half = Math.max(LEAST, 0.65 * (most - least));
    const step = niceStep(2 * half / 4);
    return [Math.floor((middle - half) / step) * step, Math.ceil((middle + half) / step) * step,
      step];
  }

  #line(context, column, style, x, y) {
    context.strokeStyle = style;
    context.lineWidth = 2;
    context.lineJoin = 'round';
    context.beginPath();
    let before = null;
    for (const row of this.#rows) {
      const value = row[column];
      if (value !== null) {
        const joined = before !== null && row[0] - before < GAP;
        context[joined ? 'lineTo' : 'moveTo'](x(row[0]), y(value));
      }
      before = value === null ? null : row[0];
    }
    context.stroke();
  }

  #describe() {
    const last = this.#rows.at(-1);
    const words = last ? `|a| minus 1 g now: raw ${fixed(last[1], 0, ' mg')}, corrected `
      + `${last[2] === null ? 'not known' : fixed(last[2], 0, ' mg')}` : 'no messages yet';
    label(this.#canvas, words);
  }
}

const inMg = (length) => (length === null ? null : 1000 * (length - 1));

/** Return 1, 2 or 5 times a power of ten that is not less than this. */
function niceStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return power * [1, 2, 5, 10].find((times) => times * power >= least * 0.999);
}

function drawAxes(context, { low, high, step, newest, x, y, width, height }) {
  context.font = '12px system-ui, sans-serif';
  context.lineWidth = 1;
  context.textAlign = 'right';
  context.textBaseline = 'middle';
  for (let k = Math.round(low / step); k <= Math.round(high / step); k += 1) {
    context.strokeStyle = colour(k === 0 ? 'axis' : 'grid');
    context.beginPath();
    context.moveTo(MARGIN.left, y(k * step));
    context.lineTo(width - MARGIN.right, y(k * step));
    context.stroke();
    context.fillStyle = colour('soft');
    const words = fixed(k * step, step < 1 ? 1 : 0);
    context.fillText(k > 0 ? `+${words}` : words, MARGIN.left - 8, y(k * step));
  }
  for (const ago of [60, 40, 20, 0]) {
    const words = ago ? `−${ago} s` : 'now';
    context.textAlign = ago === 60 ? 'left' : ago ? 'center' : 'right';
    context.fillText(words, x(newest - ago), height - 10);
  }
}
