// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// What matters now, in large: the ring of stillness, the next action, and how far the sensor still
// has to be turned.

import { element, label, text } from './canvas.js';
import { degreesBetween, unit } from './geometry.js';
import { fixed } from './words.js';

const REACHED = 17;  // a pose within this angle of the next one counts as it [°]

export class Hero {
  #ring = element('ring');
  #drawing = this.#ring.querySelector('svg');
  #arc = this.#ring.querySelector('.fill');
  #captured = false;  // during this rest

  /** Note that a pose was captured. */
  captured() {
    this.#captured = true;
  }

  /** Show a progress, or null: there is no connection. */
  show(progress) {
    if (!progress?.still) this.#captured = false;
    const [kind, words, more] = progress ? this.#stillness(progress) : ['silent', '–', ''];
    const share = kind === 'moving' || kind === 'silent' ? 0
      : Math.min(1, progress.dwell / Math.max(progress.min_dwell, 0.01));
    this.#ring.dataset.kind = kind;
    this.#arc.setAttribute('stroke-dasharray', `${(101 * share).toFixed(1)} 200`);
    text(element('ring-words'), words);
    text(element('ring-more'), more);
    label(this.#drawing, `stillness: ${words}${more ? `, ${more}` : ''}`);
  }

  /** Return the kind of stillness, its word, and a second line. */
  #stillness({ still, stillness, dwell, min_dwell: least }) {
    if (stillness === null) return ['silent', 'No data', 'no messages arrive'];
    if (!still) {
      return ['moving', 'Moving', stillness > 1 ? `${fixed(Math.min(stillness, 999),
        stillness < 10 ? 1 : 0)} × the limit` : 'hold it still'];
    }
    if (this.#captured) return ['captured', '✓', 'captured'];
    if (dwell >= least) return ['captured', 'Still', `${fixed(dwell, 0)} s`];
    return ['holding', fixed(Math.max(0, least - dwell), 1, ' s'), 'hold it still'];
  }
}

/** Show the next action, and the sensor as it is wanted if that is a pose. */
export function showAction({ title, words, isPose }, progress) {
  text(element('next'), title);
  text(element('advice'), words);
  text(element('count'), progress ? countWords(progress, isPose) : '');
  showTurn(progress, isPose);
}

function countWords({ poses, total }, isPose) {
  if (isPose && poses < total) return `pose ${poses + 1} of about ${total}`;
  return `${poses} ${poses === 1 ? 'pose' : 'poses'}`;
}

function showTurn(progress, isPose) {
  const both = isPose && progress.up.length > 0;
  element('wanted').hidden = !isPose;
  element('turn').hidden = !both;
  if (!both) return;
  const degrees = degreesBetween(unit(progress.direction), unit(progress.up));
  element('boxes').dataset.reached = `${degrees < REACHED}`;
  text(element('turn'), degrees < REACHED ? '✓' : `${Math.round(degrees)}°`);
}
