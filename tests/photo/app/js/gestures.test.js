/** Pointers, the wheel and keys: what they ask for. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { actionOfKey, Gestures, wheelFactor } from "../../../../nlfilter_torch/photo/app/static/gestures.js";

const LEFT = 0;
const MIDDLE = 1;
const RIGHT = 2;

const at = (id, x, y, button = LEFT) => ({ id, x, y, button, buttons: 1 });

test("one pointer draws", () => {
  const gestures = new Gestures();
  assert.equal(gestures.down(at(1, 10, 10), true), false);
  assert.ok(!gestures.isTaken);
  assert.equal(gestures.move(at(1, 20, 10)), null);
  assert.equal(gestures.up(at(1, 20, 10)), false);
});

test("the middle button moves the photograph, and any button does without a brush; the right one never", () => {
  for (const [button, hasBrush, isTaken] of [
    [MIDDLE, true, true],
    [LEFT, false, true],
    [RIGHT, true, false],
    [RIGHT, false, false],
  ]) {
    const gestures = new Gestures();
    gestures.down(at(1, 10, 10, button), hasBrush);
    assert.equal(gestures.isTaken, isTaken);
    const change = gestures.move(at(1, 25, 6));
    assert.deepEqual(change, isTaken ? { right: 15, down: -4, zoom: null } : null);
    assert.equal(gestures.up(at(1, 25, 6)), isTaken);
    assert.ok(!gestures.isTaken);
  }
});

test("two pointers zoom and move, and end the stroke that the first one has begun", () => {
  const gestures = new Gestures();
  gestures.down(at(1, 100, 100), true);
  assert.equal(gestures.down(at(2, 200, 100), true), true);
  assert.ok(gestures.isTaken);
  assert.deepEqual(gestures.move(at(2, 300, 100)), { right: 50, down: 0, zoom: { factor: 2, x: 150, y: 100 } });
  assert.deepEqual(gestures.move(at(1, 100, 140)), {
    right: 0,
    down: 20,
    zoom: { factor: Math.hypot(200, 40) / 200, x: 200, y: 100 },
  });
});

test("a third pointer ends no stroke", () => {
  const gestures = new Gestures();
  gestures.down(at(1, 100, 100), true);
  gestures.down(at(2, 200, 100), true);
  assert.equal(gestures.down(at(3, 300, 100), true), false);
});

test("the pointer that is left after a pinch does nothing until it is lifted", () => {
  const gestures = new Gestures();
  gestures.down(at(1, 100, 100), true);
  gestures.down(at(2, 200, 100), true);
  assert.ok(gestures.up(at(1, 100, 100)));
  assert.deepEqual(gestures.move(at(2, 250, 100)), { right: 0, down: 0, zoom: null });
  assert.ok(gestures.isTaken);
  assert.ok(gestures.up(at(2, 250, 100)));
  assert.ok(!gestures.isTaken);
  gestures.down(at(3, 10, 10), true);
  assert.ok(!gestures.isTaken); // it draws
});

test("two pointers at the same place have a distance", () => {
  const gestures = new Gestures();
  gestures.down(at(1, 100, 100), true);
  gestures.down(at(2, 100, 100), true);
  assert.equal(gestures.move(at(2, 105, 100)).zoom.factor, 5);
});

test("a pointer that was lifted elsewhere ends what it did", () => {
  const gestures = new Gestures();
  gestures.down(at(1, 10, 10, MIDDLE), true);
  assert.equal(gestures.move({ ...at(1, 20, 10), buttons: 0 }), null);
  assert.ok(!gestures.isTaken);
  assert.equal(gestures.move(at(1, 30, 10)), null);
});

test("pointers that were not put down on the canvas are ignored", () => {
  const gestures = new Gestures();
  assert.equal(gestures.move(at(1, 20, 10)), null);
  assert.equal(gestures.up(at(1, 20, 10)), false);
});

test("the wheel zooms in when it is turned away, and back by the same factor", () => {
  const turn = (deltaY, more = {}) => wheelFactor({ deltaY, deltaMode: 0, ctrlKey: false, ...more });
  assert.ok(turn(-100) > 1);
  assert.ok(Math.abs(turn(-100) * turn(100) - 1) < 1e-12);
  assert.equal(turn(-100), Math.exp(0.2));
  assert.equal(turn(-3, { deltaMode: 1 }), turn(-72)); // lines
  assert.equal(turn(-10, { ctrlKey: true }), turn(-50)); // a pinch on a touchpad
});

test("keys", () => {
  assert.deepEqual(["+", "=", "-", "_"].map((key) => actionOfKey(key, 800)), [
    ["step", 1],
    ["step", 1],
    ["step", -1],
    ["step", -1],
  ]);
  assert.deepEqual(["0", "1", " "].map((key) => actionOfKey(key, 800)), [["fit"], ["full"], ["hand", true]]);
  assert.deepEqual(["o", "\\"].map((key) => actionOfKey(key, 800)), [
    ["original", true],
    ["original", true],
  ]);
  assert.deepEqual(actionOfKey("ArrowLeft", 800), ["pan", 120, 0]);
  assert.deepEqual(actionOfKey("ArrowDown", 800), ["pan", 0, -120]);
  assert.deepEqual(["b", "E", "s"].map((key) => actionOfKey(key, 800)), [
    ["tool", "added"],
    ["tool", "removed"],
    ["tool", "object"],
  ]);
  assert.equal(actionOfKey("a", 800), null);
  assert.equal(actionOfKey("toString", 800), null);
});
