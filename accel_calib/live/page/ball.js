// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// The ball of directions in sensor axes: green where a pose is near. It turns with the sensor, so
// that the direction that points up is at its top, until it is turned by drag or arrow keys.

import { cleared, colour, label } from './canvas.js';
import { apply, camera, dot, orthonormal, product, radians, rotation, spherePoints } from './geometry.js';

const VIEW = camera(32, 42);
const POINTS = spherePoints(620);
const NEAR = Math.cos(radians(45));  // as in the coverage of the calibrator
const KEY_STEP = radians(10);
const KEYS = {
  ArrowLeft: [0, -KEY_STEP], ArrowRight: [0, KEY_STEP],
  ArrowUp: [-KEY_STEP, 0], ArrowDown: [KEY_STEP, 0],
};

export class Ball {
  #canvas;
  #frame;
  #follow;
  #poses = [];
  #covered = POINTS.map(() => false);
  #next = null;
  #up = null;
  #attitude = null;
  #turned = null;  // from the sensor to the view, if the user has turned the ball
  #last = null;
  dirty = true;

  constructor(canvas, frame, follow) {
    [this.#canvas, this.#frame, this.#follow] = [canvas, frame, follow];
    frame.addEventListener('keydown', (event) => this.#onKey(event));
    frame.addEventListener('pointerdown', (event) => {
      this.#last = [event.clientX, event.clientY];
      frame.setPointerCapture(event.pointerId);
    });
    frame.addEventListener('pointermove', (event) => this.#onDrag(event));
    for (const name of ['pointerup', 'pointercancel']) {
      frame.addEventListener(name, () => { this.#last = null; });
    }
    follow.addEventListener('click', () => {
      this.#turned = null;
      this.dirty = true;
      follow.hidden = true;
      frame.focus();
    });
  }

  /** Set the directions of up in the captured poses. */
  setPoses(poses) {
    this.#poses = poses;
    this.#covered = POINTS.map((point) => poses.some((pose) => dot(point, pose) >= NEAR));
    this.dirty = true;
  }

  /** Set the next direction and the present one; an empty array: not known. */
  set(next, up) {
    this.#next = next.length ? next : null;
    this.#up = up.length ? up : null;
    this.dirty = true;
  }

  draw(attitude) {
    this.dirty = false;
    this.#attitude = attitude;
    const { context, width, height } = cleared(this.#canvas);
    const radius = Math.min(width, height) / 2 - 22;
    if (radius <= 0) return;
    context.translate(width / 2, height / 2);
    const view = this.#view();
    this.#drawPoints(context, view, radius);
    this.#drawPoses(context, view, radius);
    if (this.#next) drawNext(context, apply(view, this.#next), radius);
    if (this.#up) drawUp(context, apply(view, this.#up), radius);
    this.#describe();
  }

  #view() {
    return this.#turned ?? (this.#attitude ? product(VIEW, this.#attitude) : VIEW);
  }

  #drawPoints(context, view, radius) {
    context.fillStyle = colour('disc');
    circle(context, 0, 0, radius + 6);
    context.fill();
    const dotRadius = Math.max(1.6, radius * 0.028);
    for (const [k, point] of POINTS.entries()) {
      const [x, y, depth] = apply(view, point);
      if (depth < -0.05) continue;
      context.globalAlpha = 0.25 + 0.75 * Math.max(0, depth);
      context.fillStyle = colour(this.#covered[k] ? 'good' : 'open');
      circle(context, x * radius, -y * radius, dotRadius * (0.6 + 0.4 * depth));
      context.fill();
    }
    context.globalAlpha = 1;
  }

  #drawPoses(context, view, radius) {
    context.lineWidth = 2;
    for (const pose of this.#poses) {
      const [x, y, depth] = apply(view, pose);
      if (depth < 0) continue;
      context.fillStyle = colour('ink');
      context.strokeStyle = colour('disc');
      circle(context, x * radius, -y * radius, Math.max(4, radius * 0.05));
      context.fill();
      context.stroke();
    }
  }

  #describe() {
    const share = this.#covered.filter(Boolean).length / POINTS.length;
    label(this.#canvas, `ball of directions: ${this.#poses.length} `
      + `${this.#poses.length === 1 ? 'pose' : 'poses'}, ${Math.round(100 * share)} % covered`);
  }

  #onKey(event) {
    const step = KEYS[event.key];
    if (step === undefined || event.altKey || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    this.#turn(...step);
  }

  #onDrag(event) {
    if (this.#last === null) return;
    const [x, y] = this.#last;
    this.#last = [event.clientX, event.clientY];
    const scale = 2 / Math.max(1, Math.min(this.#canvas.clientWidth, this.#canvas.clientHeight));
    this.#turn((event.clientY - y) * scale, (event.clientX - x) * scale);
  }

  /** Turn the ball by these angles about the axes to the right and up of the view [rad]. */
  #turn(aboutRight, aboutUp) {
    const both = product(rotation([1, 0, 0], aboutRight), rotation([0, 1, 0], aboutUp));
    this.#turned = orthonormal(product(both, this.#view()));
    this.#follow.hidden = false;
    this.dirty = true;
  }
}

function circle(context, x, y, radius) {
  context.beginPath();
  context.arc(x, y, Math.max(0, radius), 0, 2 * Math.PI);
}

/** Draw the ring around the next direction; pale if it is on the far side. */
function drawNext(context, [x, y, depth], radius) {
  context.globalAlpha = depth < 0 ? 0.35 : 1;
  context.strokeStyle = colour('accent');
  context.lineWidth = 4;
  circle(context, x * radius, -y * radius, Math.max(9, radius * 0.11));
  context.stroke();
  context.globalAlpha = 1;
}

/** Draw a pin at the direction that points up now. */
function drawUp(context, [x, y, depth], radius) {
  context.globalAlpha = depth < 0 ? 0.35 : 1;
  context.strokeStyle = colour('after');
  context.fillStyle = colour('after');
  context.lineWidth = 3;
  context.beginPath();
  context.moveTo(x * radius, -y * radius);
  context.lineTo(x * radius * 1.16, -y * radius * 1.16);
  context.stroke();
  circle(context, x * radius, -y * radius, Math.max(4, radius * 0.045));
  context.fill();
  context.globalAlpha = 1;
}
