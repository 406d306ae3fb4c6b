// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// The live page of the calibrator: it takes the messages of the stream and shows them.

import { Attitude, Wanted } from './attitude.js';
import { Awake } from './awake.js';
import { Ball } from './ball.js';
import { drawBox } from './box.js';
import { element, label, onColours, text } from './canvas.js';
import { Chart } from './chart.js';
import { Commands } from './commands.js';
import { Connection } from './connection.js';
import { nextAction } from './guide.js';
import { Hero, showAction } from './hero.js';
import { LogView } from './log.js';
import { Result } from './result.js';
import { Sound } from './sound.js';
import { Speech } from './speech.js';
import { countOf, figure, fixed, sideOf, withButtons } from './words.js';

const attitude = new Attitude();
const wanted = new Wanted();
const ball = new Ball(element('ball'), element('ball-frame'), element('follow'));
const chart = new Chart(element('chart'));
const hero = new Hero();
const log = new LogView(element('log'));
const result = new Result();
const sound = new Sound(element('sound'));
const awake = new Awake();

let state = null;
let open = false;
let progress = null;
let version = '';
let announced = '';
let redraw = true;

const connection = new Connection({ message: take, state: showConnection, seen: () => log.seen });
const commands = new Commands(connection, announce);
const speech = new Speech(element('speech'), (words) => commands.show({ success: false, words }));

const KINDS = {
  welcome: takeWelcome, progress: takeProgress, poses: ({ up }) => ball.setPoses(up),
  state: takeState, log: (line) => log.add(line),
};

function take(message) {
  KINDS[message.kind]?.(message);
}

function takeWelcome({ may, why, version: now, history, exports = [] }) {
  if (version && now !== version) location.reload();  // the modules may be of another version
  version = now;
  commands.allow(may, why);
  commands.setFormats(exports);
  notice('showing', may ? '' : `Only showing: ${why}`);
  chart.setHistory(history);
  announced = '';
}

function takeProgress(now) {
  const isNew = progress !== null && now.poses > progress.poses;
  progress = now;
  if (isNew) {
    hero.captured();
    sound.captured();
    commands.hideSuccess();
  }
  hero.show(progress);
  if (progress.up.length) attitude.set(progress.up);
  element('box-now').hidden = attitude.matrix === null;
  text(element('now-words'), attitude.matrix ? 'now' : now.stillness === null ? ''
    : 'How it is held now is known after about 4 poses. Hold it like the other box.');
  redraw = wanted.set(progress.direction) || redraw;
  ball.set(progress.direction, progress.up);
  chart.add(now.time, now.length, now.corrected);
  showNumbers(progress);
  guide(isNew);
}

function takeState(now) {
  state = now;
  document.title = now.sensor ? `${now.sensor} – calibration` : 'Accelerometer calibration';
  text(element('sensor'), now.sensor || 'Accelerometer');
  const words = withButtons(now.state);
  text(element('state'), now.source ? `${words} · ${now.source}` : words);
  notice('problem', withButtons(now.problem));
  commands.setOffer(now.preview, now.rating);
  commands.setBusy(now.busy);
  commands.setLevelled(now.levelled);
  result.show(now);
  guide(false);
}

/** Show and announce the next action; `captured`: a pose was captured just now. */
function guide(captured) {
  const next = nextAction(progress, state, open);
  showAction(next, open ? progress : null);
  commands.setNext(next.command);
  if (next.title === announced && !captured) return;
  announced = next.title;
  const end = /\w$/.test(next.title) ? '.' : '';
  const words = `${captured ? `Pose ${progress.poses} captured. ` : ''}${next.title}${end}`;
  announce(words);
  speech.say(words);
}

function showNumbers(now) {
  text(element('poses'), countOf(now.poses, now.total));
  const numbers = {
    coverage: now.coverage === null ? '–' : `${Math.round(100 * now.coverage)} %`,
    accuracy: accuracyOf(now.accuracy, state?.counts_per_g),
    length: fixed(now.corrected ?? now.length, 4, ' g'),
    temperature: fixed(now.temperature, 1, ' °C') };
  for (const [name, words] of Object.entries(numbers)) {
    text(element(name), words);
    element(name).parentElement.hidden = words === '–';
  }
}

/** Return an accuracy [g] in mg, and in counts if the readings are counts. */
function accuracyOf(error, countsPerG) {
  if (error === null) return '–';
  const counts = countsPerG ? ` (${figure(error * countsPerG)} counts)` : '';
  return `${figure(1000 * error)} mg${counts}`;
}

function showConnection(name) {
  document.body.dataset.connection = name;
  notice('connection', {
    connecting: 'Connecting to the calibrator …',
    lost: 'The connection is lost. The page tries again.', open: '' }[name]);
  open = name === 'open';
  awake.keep(open);
  if (name !== 'lost') return;
  commands.allow(false, 'there is no connection to the calibrator');
  hero.show(null);
  guide(false);
}

function notice(id, words) {
  element(id).hidden = !words;
  text(element(id), words);
}

/** Read a text to users of screen readers. */
function announce(words) {
  element('live').textContent = words;
}

let last = performance.now();

function draw(now) {
  const seconds = Math.min(0.1, (now - last) / 1000);
  last = now;
  const turned = attitude.step(seconds);
  const other = wanted.step(attitude.matrix, seconds);
  if (turned || redraw) drawBox(element('box-now'), attitude.matrix);
  if (other || redraw) drawBox(element('box-wanted'), wanted.matrix);
  if (turned || redraw || ball.dirty) ball.draw(attitude.matrix);
  chart.draw(now);
  if (progress) labelBoxes();
  redraw = false;
  requestAnimationFrame(draw);
}

function labelBoxes() {
  const { direction, up } = progress;
  label(element('box-now'), up.length ? `the sensor now: ${sideOf(up)} up` : 'the sensor now');
  label(element('box-wanted'), direction.length ? `the sensor as wanted: ${sideOf(direction)} up`
    : 'no pose is wanted');
}

function drawAll() {
  redraw = true;
  chart.redraw();
}

onColours(drawAll);
new ResizeObserver(drawAll).observe(element('boxes'));
new ResizeObserver(drawAll).observe(element('ball'));
new ResizeObserver(drawAll).observe(element('chart'));
requestAnimationFrame(draw);
