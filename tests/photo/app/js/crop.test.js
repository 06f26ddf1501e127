/** The frame of the crop: when the server is told its edges, and which of its answers are shown. */

import assert from "node:assert/strict";
import { mock, test } from "node:test";

const frame = { style: {}, querySelectorAll: () => [] };
const picture = { style: {}, querySelector: () => ({}) };
const over = new Set(); // what is open over the frame
const parts = { ".crop-picture": picture, ".crop-frame": frame, ".cropper": { addEventListener() {} } };
const sent = [];
let press;

globalThis.emitEvent = (name, value) => sent.push(value ? `${name} ${value.map((edge) => edge.toFixed(2))}` : name);
globalThis.document = {
  documentElement: { classList: { add() {}, remove() {}, contains: () => true } },
  querySelector: (selector) => parts[selector] ?? (selector.split(", ").some((part) => over.has(part)) ? {} : null),
};
globalThis.window = { addEventListener: (_, listener) => (press = listener) };
mock.timers.enable({ apis: ["setTimeout"] });
await import("../../../../nlfilter_torch/photo/app/static/crop.js");
const { cropper } = globalThis.window;

const keysAt = (edge, names) => {
  for (const key of names) {
    press({ key, target: { dataset: { edge } }, shiftKey: false, stopPropagation() {}, preventDefault() {} });
  }
};
const keys = (...names) => keysAt("left", names);
const told = () => sent.splice(0);

test("keys are told after a rest, or before the end", () => {
  cropper.show("whole", 100, 100, [0, 0, 1, 1]);
  keys("ArrowRight", "ArrowRight");
  assert.deepEqual(told(), []);
  mock.timers.tick(400);
  assert.deepEqual(told(), ["crop 0.02,0.00,1.00,1.00"]);
  keys("Escape");
  assert.deepEqual(told(), ["crop_done"]);
  for (const end of ["Enter", "Escape"]) {
    cropper.show("whole", 100, 100, [0, 0, 1, 1]);
    keys("ArrowRight", end);
    cropper.hide();
    mock.timers.tick(400);
    assert.deepEqual(told(), ["crop 0.01,0.00,1.00,1.00", "crop_done"]);
  }
});

test("keys belong to an open dialog or list", () => {
  cropper.show("whole", 100, 100, [0, 0, 1, 1]);
  for (const [what, edge] of [
    [".q-dialog", "left"],
    [".q-menu", undefined],
  ]) {
    over.add(what);
    keysAt(edge, ["Escape", "ArrowRight", "Enter"]);
    mock.timers.tick(400);
    assert.deepEqual(told(), []);
    over.delete(what);
  }
  keysAt(undefined, ["Escape"]);
  assert.deepEqual(told(), ["crop_done"]);
});

test("keys belong to an edge that has the focus while a list fades", () => {
  cropper.show("whole", 100, 100, [0, 0, 1, 1]);
  over.add(".q-menu");
  keys("ArrowRight");
  mock.timers.tick(400);
  over.clear();
  assert.deepEqual(told(), ["crop 0.01,0.00,1.00,1.00"]);
});

test("a frame keeps the aspect that the server tells", () => {
  cropper.show("whole", 100, 100, [0, 0, 1, 1], 2);
  keys("ArrowRight");
  mock.timers.tick(400);
  assert.deepEqual(told(), ["crop 0.01,0.25,1.00,0.75"]);
  cropper.show("whole", 100, 100, [0, 0, 1, 1]);
});

test("an answer does not undo keys that were pressed meanwhile", () => {
  cropper.show("whole", 100, 100, [0, 0, 1, 1]);
  keys("ArrowRight");
  mock.timers.tick(400);
  keys("ArrowRight", "ArrowRight");
  cropper.show("whole", 100, 100, [0.01, 0, 1, 1]);
  mock.timers.tick(400);
  assert.deepEqual(told(), ["crop 0.01,0.00,1.00,1.00", "crop 0.03,0.00,1.00,1.00"]);
  cropper.show("whole", 100, 100, [0.04, 0, 1, 1]);
  assert.equal(frame.style.left, "4%");
});
