// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// The sensor as a box with the names of its sides, and its axes beside it. Hidden sides are not
// drawn.

import { VIEW } from './attitude.js';
import { cleared, colour } from './canvas.js';
import { apply, product } from './geometry.js';
import { SIDES } from './words.js';

const HALF = [0.75, 0.55, 0.34];  // half the size along x, y and z
const EXTENT = 1.02;  // half the height of the drawing, in the unit of HALF
const AXES = { margin: 0.36, farthest: 1.15, y: 0.68, length: 0.23 };  // where the axes are drawn

const axisVector = (axis, length) => [0, 1, 2].map((k) => (k === axis ? length : 0));

/** Draw the box in this attitude, a rotation from the sensor to the room; null: nothing. */
export function drawBox(canvas, attitude) {
  const { context, width, height } = cleared(canvas);
  if (attitude === null || width === 0) return;
  const scale = Math.min(width / 1.1, height) / (2 * EXTENT);
  context.translate(width / 2, height / 2);
  context.scale(scale, scale);
  const view = product(VIEW, attitude);
  const seen = (point) => {
    const [x, y, depth] = apply(view, point);
    return { x, y: -y, depth };
  };
  for (const [axis, pair] of SIDES.entries()) {
    for (const [k, name] of pair.entries()) {
      const sign = k === 0 ? 1 : -1;
      if (seen(axisVector(axis, sign)).depth > 1e-6) drawSide(context, axis, sign, name, seen);
    }
  }
  const left = -Math.min(AXES.farthest, width / (2 * scale) - AXES.margin);
  [0, 1, 2].map((axis) => ({ axis, end: seen(axisVector(axis, 1)) }))
    .sort((a, b) => a.end.depth - b.end.depth)
    .forEach(({ axis, end }) => drawAxis(context, axis, end, left));
}

function drawSide(context, axis, sign, name, seen) {
  const across = axis === 0 ? 1 : 0;
  const along = axis === 2 ? 1 : 2;
  const at = axisVector(axis, sign * HALF[axis]);
  const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([u, v]) => {
    const corner = [...at];
    corner[across] = u * HALF[across];
    corner[along] = v * HALF[along];
    return seen(corner);
  });
  context.fillStyle = colour(`side-${name}`);
  context.strokeStyle = colour('paper');
  context.lineWidth = 0.025;
  context.lineJoin = 'round';
  context.beginPath();
  corners.forEach(({ x, y }, k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.closePath();
  context.fill();
  context.stroke();
  drawName(context, name, seen(axisVector(across, 1)), seen(axisVector(along, -1)), seen(at));
}

/** Write a name on its side, neither mirrored nor upside down. */
function drawName(context, name, right, down, at) {
  let [a, b] = [right, down];
  if (a.x * b.y - a.y * b.x < 0) a = { x: -a.x, y: -a.y };
  if (a.x < 0) [a, b] = [{ x: -a.x, y: -a.y }, { x: -b.x, y: -b.y }];
  context.save();
  context.transform(a.x, a.y, b.x, b.y, at.x, at.y);
  context.scale(0.01, 0.01);  // browsers do not draw letters smaller than a pixel
  context.font = `600 ${name.length > 5 ? 27 : 31}px system-ui, sans-serif`;
  context.textAlign = 'center';
  context.textBaseline = 'middle';
  context.fillStyle = colour(`name-${name}`);
  context.fillText(name, 0, 0);
  context.restore();
}

function drawAxis(context, axis, { x, y, depth }, left) {
  context.save();
  context.translate(left, AXES.y);
  context.globalAlpha = depth < -0.05 ? 0.5 : 1;
  context.strokeStyle = colour(`axis-${'xyz'[axis]}`);
  context.fillStyle = colour('ink');
  context.lineWidth = 0.05;
  context.lineCap = 'round';
  context.beginPath();
  context.moveTo(0, 0);
  context.lineTo(AXES.length * x, AXES.length * y);
  context.stroke();
  const away = AXES.length + 0.1;
  const side = Math.max(0, 0.1 - away * Math.hypot(x, y));  // beside an axis to the viewer
  context.translate(away * x - side, away * y - side);
  context.scale(0.01, 0.01);
  context.font = '600 16px system-ui, sans-serif';
  context.textAlign = 'center';
  context.textBaseline = 'middle';
  context.fillText('xyz'[axis], 0, 0);
  context.restore();
}
