// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// The attitude in which the sensor is drawn, from the direction of up alone. Gravity does not
// determine the heading, so each frame takes the shortest rotation from the one before. The
// drawing therefore never jumps.

import {
  apply, camera, cross, dot, orthonormal, product, radians, rotation, shortest, transposed, unit,
} from './geometry.js';

const Z = [0, 0, 1];
const SMOOTHING = 0.08;  // time constant [s]

/** Camera of the boxes. The pictures of the documentation have the same. */
export const VIEW = camera(32, 24);

/** Return the attitude with this direction up that shows most of front, left and top. */
function attitudeOf(up) {
  const first = unit(cross(up, Math.abs(up[2]) < 0.9 ? Z : [1, 0, 0]));
  const level = [first, cross(up, first), up];
  let best = level;
  let most = -Infinity;
  for (let degrees = 0; degrees < 360; degrees += 5) {
    const turned = product(rotation(Z, radians(degrees)), level);
    const shown = dot([1, 0.8, 0.6], apply(transposed(turned), VIEW[2]));
    if (shown > most + 1e-9) [best, most] = [turned, shown];
  }
  return best;
}

export class Attitude {
  /** Rotation from the sensor to the room; null before the first direction. */
  matrix = null;
  #up = null;
  #newest = null;

  /** Set the newest direction of up, a unit vector in sensor axes. */
  set(up) {
    this.#newest = unit(up);
    if (this.matrix === null) {
      this.#up = this.#newest;
      this.matrix = attitudeOf(this.#up);
    }
  }

  /** Turn towards the newest direction; return whether the drawing changes. */
  step(seconds) {
    if (this.matrix === null) return false;
    const share = 1 - Math.exp(-seconds / SMOOTHING);
    const gap = this.#newest.map((part, k) => part - this.#up[k]);
    if (Math.hypot(...gap) < 2e-4) return false;
    this.#up = unit(this.#up.map((part, k) => part + share * gap[k]));
    this.matrix = orthonormal(
      product(shortest(apply(this.matrix, this.#up), Z), this.matrix));
    return true;
  }
}

export class Wanted {
  matrix = null;
  #direction = null;

  /** Set the direction to point up; an empty one: none. */
  set(direction) {
    const same = this.#direction && direction.length
      && direction.every((part, k) => part === this.#direction[k]);
    if (same) return false;
    this.#direction = direction.length ? direction : null;
    this.matrix = this.#direction && attitudeOf(unit(direction));
    return true;
  }

  /** Turn about the vertical towards the present attitude, so that both drawings agree at last. */
  step(present, seconds) {
    if (this.matrix === null || present === null) return false;
    const between = product(this.matrix, transposed(present));
    const sine = between[1][0] - between[0][1];
    const cosine = between[0][0] + between[1][1];
    const known = Math.min(1, Math.hypot(sine, cosine) / 2);  // 0: any heading is as near
    const angle = -Math.atan2(sine, cosine) * known * (1 - Math.exp(-seconds / (4 * SMOOTHING)));
    if (Math.abs(angle) < 1e-4) return false;
    this.matrix = orthonormal(product(rotation(Z, angle), this.matrix));
    return true;
  }
}
