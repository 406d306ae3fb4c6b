// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// Show in data-awake whether the page holds a wake lock.
const request = WakeLock.prototype.request;
WakeLock.prototype.request = async function (kind) {
  const lock = await request.call(this, kind);
  const show = () => { document.documentElement.dataset.awake = `${!lock.released}`; };
  lock.addEventListener('release', show);
  show();
  return lock;
};
