// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// What matters now, in large: the ring of stillness, the words of the next pose, and how far the
// sensor still has to be turned.

import { label, text } from './canvas.js';
import { degreesBetween, unit } from './geometry.js';
import { capitalised, fixed, sideOf, withButtons } from './words.js';

const REACHED = 17;  // a pose within this angle of the next one counts as it [°]

const element = (id) => document.getElementById(id);

export class Hero {
  #ring = element('ring');
  #drawing = this.#ring.querySelector('svg');
  #arc = this.#ring.querySelector('.fill');
  #captured = false;  // during this rest

  /** Note that a pose was captured. */
  captured() {
    this.#captured = true;
  }

  /** Show a progress, and what the calibrator is busy with. */
  show(progress, state) {
    if (!progress.still) this.#captured = false;
    const [kind, words, more] = this.#stillness(progress);
    const share = kind === 'moving' || kind === 'silent' ? 0
      : Math.min(1, progress.dwell / Math.max(progress.min_dwell, 0.01));
    this.#ring.dataset.kind = kind;
    this.#arc.setAttribute('stroke-dasharray', `${(101 * share).toFixed(1)} 200`);
    text(element('ring-words'), words);
    text(element('ring-more'), more);
    label(this.#drawing, `stillness: ${words}${more ? `, ${more}` : ''}`);
    showGoal(progress, state);
    showTurn(progress);
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

/** Return the words in large: the side to point up, or what to do instead. */
export function goalOf({ direction, advice }, state) {
  if (state.busy) return `${capitalised(state.busy.replaceAll('_', ' '))} is running …`;
  if (state.preview) return 'Accept it?';
  if (direction.length) return `${capitalised(sideOf(direction))} up`;
  const command = advice.match(/call ~\/(fit|refine)/);
  if (command) return `Press ${capitalised(command[1])}`;
  return advice ? 'Done' : 'Waiting';
}

function showGoal(progress, state) {
  const { poses, total } = progress;
  text(element('count'), poses < total ? `pose ${poses + 1} of about ${total}`
    : `${poses} ${poses === 1 ? 'pose' : 'poses'}`);
  text(element('next'), goalOf(progress, state));
  text(element('advice'), capitalised(withButtons(progress.advice)));
}

function showTurn({ direction, up }) {
  const both = direction.length > 0 && up.length > 0;
  element('wanted').hidden = direction.length === 0;
  element('turn').hidden = !both;
  if (!both) return;
  const degrees = degreesBetween(unit(direction), unit(up));
  element('boxes').dataset.reached = `${degrees < REACHED}`;
  text(element('turn'), degrees < REACHED ? '✓' : `${Math.round(degrees)}°`);
}
