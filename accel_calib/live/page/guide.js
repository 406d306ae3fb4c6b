// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// The next action of the user: the words in large, a line that explains them, and the command
// whose button does it.

import { buttonOf, capitalised, sideOf, withButtons } from './words.js';

const LONG = ['fit', 'refine'];  // the other commands end before their name could be read

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
  if (state.preview) return offered(state.rating);
  const mayFit = /call ~\/(fit|refine)/.exec(progress.advice)?.[1] ?? '';
  const words = sentence(progress.advice);
  if (isFinished(progress, state)) return finished(progress, state);
  if (progress.direction.length) return pose(progress, words, mayFit);
  const command = mayFit || (progress.poses > 0 && !state.calibration ? 'fit' : '');
  return command ? action(`Press ${buttonOf(command)}`, words, command) : action('Waiting', words);
}

const action = (title, words, command = '', isPose = false) => ({ title, words, command, isPose });

function offered(rating) {
  if (!rating) return action('Accept it?', 'Its verdict comes in a moment.', 'save');
  const words = sentence(rating.reason);
  if (rating.rating === 'BAD') return action('Bad. Take it back?', words, 'undo');
  return action(`${capitalised(rating.rating.toLowerCase())}. Accept it?`, words, 'save');
}

/**
 * Return whether the calibration in use has all poses. One pose more does not change a good one,
 * because the rest for Set level is captured, too.
 */
function isFinished({ poses, direction }, { calibration, result, rating }) {
  if (!calibration || !result || !rating) return false;
  const more = poses - result.poses - result.left_out;
  return rating.rating === 'GOOD' ? more === 0 || more === 1 : more === 0 && !direction.length;
}

/** Return what to do with a calibration in use. */
function finished({ stillness, direction, advice }, { rating, levelled }) {
  if (rating.rating !== 'GOOD') {
    return action(capitalised(rating.rating.toLowerCase()),
      `${sentence(rating.reason)} ${sentence(rating.advice)}`);
  }
  if (levelled || stillness === null) {
    return action('Done', 'The calibration is in use. Nothing more needs to be done.');
  }
  const more = direction.length ? ` Or go on: ${withButtons(advice)}.` : '';
  return action('Set level', 'The calibration is in use. On a robot: place the robot level, hold '
    + `it still and press Set level. A sensor alone is done.${more}`, 'set_level');
}

function pose({ direction, stillness }, words, command) {
  if (stillness === null) return action('Waiting for data', command ? words : '', command);
  return action(`${capitalised(sideOf(direction))} up`, words, command, true);
}

/** Return a text of the calibrator as a sentence. */
function sentence(words) {
  if (!words) return '';
  return `${capitalised(withButtons(words))}.`;
}
