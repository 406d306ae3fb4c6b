// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// The next action of the user: the words in large, a line that explains them, and the command
// whose button does it.

import { buttonOf, capitalised, sideOf, withButtons } from './words.js';

const LONG = ['fit', 'refine'];  // the other commands end before their name could be read

/** Titles of the steps that are no pose and no button. */
const TITLES = {
  connect: 'Check the data', unit: 'Check the unit', still: 'Hold it still',
  restart: 'Start it in another way', enable: 'Switch the correction on', done: 'Done' };

/**
 * Return the next action: title, words, command, and whether it is a pose.
 *
 * `state` is null before the first one, and `open` whether there is a connection.
 */
export function nextAction(progress, state, open) {
  if (!open) {
    return action('No connection', 'The page tries again. Your poses are kept.');
  }
  if (!progress || !state) return action('Waiting', '');
  if (LONG.includes(state.busy)) {
    return action(`${buttonOf(state.busy)} is running …`, 'The page shows the result at its end.');
  }
  const { step, command, direction } = progress;
  const words = sentence(progress.advice);
  if (step === 'accept') return offered(state.rating, state.mounting);
  if (direction.length) {
    return action(`${capitalised(sideOf(direction))} up`, words, command, true);
  }
  if (step === 'poses') return morePoses(state.rating, words, command);
  if (step === 'level') return action(buttonOf(command), words, command);
  if (command) return action(`Press ${buttonOf(command)}`, words, command);
  return action(TITLES[step] ?? 'Waiting', words);
}

const action = (title, words, command = '', isPose = false) => ({ title, words, command, isPose });

function offered(rating, mounting) {
  if (!rating) return action('Accept it?', 'Its verdict comes in a moment.', 'save');
  const words = [rating.reason, mounting].map(sentence).join(' ').trim();
  if (rating.rating === 'BAD') return action('Bad. Take it back?', words, 'undo');
  return action(`${capitalised(rating.rating.toLowerCase())}. Accept it?`, words, 'save');
}

/** Return that other poses are needed, and why the calibration is not good. */
function morePoses(rating, words, command) {
  if (!rating) return action('More poses', words, command);
  return action(capitalised(rating.rating.toLowerCase()),
    `${sentence(rating.reason)} ${words}`, command);
}

/** Return a text of the calibrator as a sentence. */
function sentence(words) {
  if (!words) return '';
  return `${capitalised(withButtons(words))}.`;
}
