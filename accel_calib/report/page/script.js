// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0
// Shows the text of the marker nearest to the pointer, and highlights its pose in all figures and
// in the table. The arrow keys move from marker to marker. Without the script, the browser shows
// the texts itself.


'use strict';
(() => {
  const tip = document.getElementById('tip');
  const text = new Map();
  let lit = [];
  let shown = null;
  const hide = () => {
    shown = null;
    tip.style.visibility = 'hidden';
    lit.forEach(part => part.classList.remove('lit'));
    lit = [];
  };
  const place = () => {
    if (!shown) { return; }
    const box = shown.getBoundingClientRect();
    const left = box.left + box.width / 2 - tip.offsetWidth / 2;
    const top = box.top - tip.offsetHeight - 8;
    tip.style.left = Math.max(4, Math.min(left, innerWidth - tip.offsetWidth - 4)) + 'px';
    tip.style.top = (top < 4 ? box.bottom + 8 : top) + 'px';
  };
  const show = mark => {
    hide();
    shown = mark;
    tip.textContent = text.get(mark);
    place();
    tip.style.visibility = 'visible';
    const row = mark.dataset.row;
    lit = row ? [...document.querySelectorAll('[data-row="' + row + '"]')] : [mark];
    lit.forEach(part => part.classList.add('lit'));
  };
  for (const figure of document.querySelectorAll('figure.live')) {
    const marks = [...figure.querySelectorAll('.mark')];
    for (const mark of marks) {
      const title = mark.querySelector('title');
      text.set(mark, title.textContent);
      title.remove();
    }
    let at = -1;
    const near = event => {
      let best = null, least = 24;
      for (const mark of marks) {
        const box = mark.getBoundingClientRect();
        const away = Math.hypot(box.left + box.width / 2 - event.clientX,
                                box.top + box.height / 2 - event.clientY);
        if (away < least) { least = away; best = mark; }
      }
      if (best) { at = marks.indexOf(best); show(best); } else { hide(); }
    };
    figure.addEventListener('pointermove', near);
    figure.addEventListener('pointerdown', near);
    figure.addEventListener('pointerleave', hide);
    figure.addEventListener('focus', () => {
      if (figure.matches(':focus-visible')) { at = Math.max(at, 0); show(marks[at]); }
    });
    figure.addEventListener('blur', hide);
    figure.addEventListener('keydown', event => {
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      if (event.key === 'Escape') { hide(); return; }
      if (!step) { return; }
      event.preventDefault();
      at = (at + step + marks.length) % marks.length;
      show(marks[at]);
    });
  }
  addEventListener('scroll', place, true);
})();
