// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// Vectors are arrays of 3, matrices are arrays of 3 rows. Room: z is up. View: x right, y up and
// z to the viewer.

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

export const unit = (a) => {
  const length = Math.hypot(...a);
  return length > 1e-9 ? a.map((part) => part / length) : [0, 0, 1];
};

export const apply = (mat, a) => mat.map((row) => dot(row, a));

export const transposed = (mat) => [0, 1, 2].map((k) => mat.map((row) => row[k]));

export const product = (a, b) => {
  const columns = transposed(b);
  return a.map((row) => columns.map((column) => dot(row, column)));
};

export const radians = (degrees) => degrees * Math.PI / 180;

/** Return the angle between two unit vectors [°]. */
export const degreesBetween = (a, b) =>
  Math.acos(Math.min(1, Math.max(-1, dot(a, b)))) * 180 / Math.PI;

/** Return the rotation about a unit vector by an angle [rad]. */
export const rotation = (axis, angle) => {
  const [x, y, z] = axis;
  const c = Math.cos(angle);
  const s = Math.sin(angle);
  const t = 1 - c;
  return [
    [t * x * x + c, t * x * y - s * z, t * x * z + s * y],
    [t * x * y + s * z, t * y * y + c, t * y * z - s * x],
    [t * x * z - s * y, t * y * z + s * x, t * z * z + c]];
};

/** Return the shortest rotation that takes the unit vector a to b. */
export const shortest = (a, b) => {
  const axis = cross(a, b);
  const sine = Math.hypot(...axis);
  if (sine > 1e-6) return rotation(unit(axis), Math.atan2(sine, dot(a, b)));
  if (dot(a, b) > 0) return [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  const other = Math.abs(a[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
  return rotation(unit(cross(a, other)), Math.PI);  // opposite: all axes are equally short
};

/** Return a matrix with rounding errors removed, so that it stays a rotation. */
export const orthonormal = (mat) => {
  const first = unit(mat[0]);
  const third = unit(cross(first, mat[1]));
  return [first, cross(third, first), third];
};

/** Return the rotation from room to view for a viewer at these angles [°]. */
export const camera = (azimuth, elevation) => {
  const [a, e] = [radians(azimuth), radians(elevation)];
  const viewer = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
  const right = [-Math.sin(a), Math.cos(a), 0];
  return [right, cross(viewer, right), viewer];
};

/** Return points that are spread evenly over the unit sphere. */
export const spherePoints = (count) => Array.from({ length: count }, (_, k) => {
  const z = 1 - (2 * k + 1) / count;
  const angle = k * Math.PI * (3 - Math.sqrt(5));
  const radius = Math.sqrt(1 - z * z);
  return [radius * Math.cos(angle), radius * Math.sin(angle), z];
});
