// Copyright 2026 The accel_calib authors
// SPDX-License-Identifier: Apache-2.0

// The live page of the calibrator: it takes the messages of the stream and shows them.

import { Attitude, Wanted } from './attitude.js';
import { Ball } from './ball.js';
import { drawBox } from './box.js';
import { label, onColours, text } from './canvas.js';
import { Chart } from './chart.js';
import { Commands } from './commands.js';
import { Connection } from './connection.js';
import { goalOf, Hero } from './hero.js';
import { LogView } from './log.js';
import { Result } from './result.js';
import { Sound } from './sound.js';
import { countOf, figure, fixed, sideOf, withButtons } from './words.js';

const element = (id) => document.getElementById(id);

const attitude = new Attitude();
const wanted = new Wanted();
const ball = new Ball(element('ball'), element('ball-frame'), element('follow'));
const chart = new Chart(element('chart'));
const hero = new Hero();
const log = new LogView(element('log'));
const result = new Result();
const sound = new Sound(element('sound'));

let state = { preview: false, busy: '' };
let progress = null;
let version = '';
let announced = '';
let redraw = true;

const connection = new Connection({ message: take, state: showConnection, seen: () => log.seen });
const commands = new Commands(connection, announce);

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
  const before = progress;
  progress = { ...now, direction: now.direction ?? [], up: now.up ?? [] };
  if (before && now.poses > before.poses) {
    hero.captured();
    sound.captured();
  }
  hero.show(progress, state);
  if (progress.up.length) attitude.set(progress.up);
  element('box-now').hidden = attitude.matrix === null;
  text(element('now-words'), attitude.matrix ? 'now'
    : 'How it is held now is known after about 4 poses. Hold it like the other box.');
  redraw = wanted.set(progress.direction) || redraw;
  ball.set(progress.direction, progress.up);
  chart.add(now.time, now.raw, now.corrected);
  showNumbers(progress);
  announceProgress(before);
}

function takeState(now) {
  state = now;
  document.title = now.sensor ? `${now.sensor} – calibration` : 'Accelerometer calibration';
  text(element('sensor'), now.sensor || 'Accelerometer');
  const words = withButtons(now.state);
  text(element('state'), now.source ? `${words} · ${now.source}` : words);
  notice('problem', withButtons(now.problem));
  element('offer').hidden = !now.preview;
  text(element('offer-words'), now.rating ? `${now.rating.rating}: ${now.rating.reason}` : '');
  commands.setBusy(now.busy);
  result.show(now);
  if (progress) hero.show(progress, state);
}

function showNumbers(now) {
  text(element('poses'), countOf(now.poses, now.total));
  text(element('coverage'), now.coverage === null ? '–' : `${Math.round(100 * now.coverage)} %`);
  text(element('accuracy'), now.accuracy_mg === null ? '–' : `${figure(now.accuracy_mg)} mg`);
  text(element('length'), fixed(now.corrected ?? now.raw, 4, ' g'));
  text(element('temperature'), fixed(now.temperature, 1, ' °C'));
}

function showConnection(name) {
  document.body.dataset.connection = name;
  notice('connection', {
    connecting: 'Connecting to the calibrator …',
    lost: 'The connection is lost. The page tries again.', open: '' }[name]);
  if (name === 'lost') commands.allow(false, 'there is no connection to the calibrator');
}

function notice(id, words) {
  element(id).hidden = !words;
  text(element(id), words);
}

/** Read a text to users of screen readers. */
function announce(words) {
  element('live').textContent = words;
}

/** Announce a captured pose or another advice, and not each message. */
function announceProgress(before) {
  const goal = goalOf(progress, state);
  if (goal === announced) return;
  announced = goal;
  const count = before && progress.poses > before.poses ? `Pose ${progress.poses} captured. ` : '';
  announce(`${count}${goal}.`);
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
