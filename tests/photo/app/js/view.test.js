/** Zoom and pan: which part of a photograph is seen, and where it lies. */

import assert from "node:assert/strict";
import { test } from "node:test";

import * as views from "../../../../nlfilter_torch/photo/app/static/view.js";

/** A canvas of 800x600 at (20, 60) on the page, for a photograph of 4000x2000. */
const FRAME = {
  size: { width: 4000, height: 2000 },
  room: { width: 800, height: 600 },
  box: { left: 20, top: 60, width: 800, height: 600 },
  density: 1,
};
const SMALL = { ...FRAME, size: { width: 200, height: 100 } };
const { WHOLE } = views;

/** The box of the photograph on the page, for a view. */
function photoBox(view, frame) {
  const { width, height, right, down } = views.placement(view, frame, 0);
  const { box } = frame;
  return {
    left: box.left + (box.width - width) / 2 + right,
    top: box.top + (box.height - height) / 2 + down,
    width,
    height,
  };
}

/** The point of the photograph under a point of the page. */
function under(point, view, frame) {
  const box = photoBox(view, frame);
  return [
    ((point.x - box.left) / box.width) * frame.size.width,
    ((point.y - box.top) / box.height) * frame.size.height,
  ];
}

function assertNear(actual, expected, tolerance = 1e-9) {
  assert.equal(actual.length, expected.length);
  actual.forEach((value, i) => assert.ok(Math.abs(value - expected[i]) <= tolerance, `${actual} is not ${expected}`));
}

test("the whole photograph fits the canvas", () => {
  assert.equal(views.scaleOf(WHOLE, FRAME), 0.2);
  assert.equal(views.scaleOf(WHOLE, { ...FRAME, density: 2 }), 0.4);
  assert.equal(views.scaleOf({ scale: 3, x: 0, y: 0 }, FRAME), 3);
  assert.ok(!views.isCloseup(WHOLE));
  assert.deepEqual(views.placement(WHOLE, FRAME, 30), {
    width: 800,
    height: 400,
    right: 0,
    down: 0,
    left: 0,
    top: 0,
    cut: 30,
  });
  assert.deepEqual(views.visiblePart(views.withinBorders(WHOLE, FRAME), FRAME), [0, 0, 4000, 2000]);
});

test("pieces are asked for from half of the full size on", () => {
  assert.ok(!views.isCloseup({ scale: 0.49, x: 0, y: 0 }));
  assert.ok(views.isCloseup({ scale: 0.5, x: 0, y: 0 }));
});

test("the visible part is around the middle, and within the photograph", () => {
  assert.deepEqual(views.visiblePart({ scale: 1, x: 1000, y: 500 }, FRAME), [600, 200, 1400, 800]);
  assert.deepEqual(views.visiblePart({ scale: 1, x: 1000.5, y: 500.5 }, FRAME), [600, 200, 1401, 801]);
  assert.deepEqual(views.visiblePart({ scale: 1, x: 100, y: 1900 }, FRAME), [0, 1600, 500, 2000]);
  assert.deepEqual(views.visiblePart({ scale: 2, x: 1000, y: 500 }, { ...FRAME, density: 2 }), [600, 200, 1400, 800]);
});

test("nothing beyond the border is visible", () => {
  assert.deepEqual(views.withinBorders({ scale: 1, x: 100, y: 1900 }, FRAME), { scale: 1, x: 400, y: 1700 });
  assert.deepEqual(views.withinBorders({ scale: 1, x: 3990, y: -5 }, FRAME), { scale: 1, x: 3600, y: 300 });
  // A photograph that is lower than the canvas lies in its middle.
  assert.deepEqual(views.withinBorders({ scale: 0.25, x: 2000, y: 1500 }, FRAME), { scale: 0.25, x: 2000, y: 1000 });
});

test("a zoom leaves the photograph where it is under the pointer", () => {
  for (const point of [
    { x: 420, y: 360 },
    { x: 100, y: 300 },
    { x: 700, y: 500 },
  ]) {
    const before = under(point, WHOLE, FRAME);
    const once = views.zoomed(FRAME, 0.8, point, photoBox(WHOLE, FRAME));
    assert.equal(once.scale, 0.8);
    assertNear(under(point, once, FRAME), before, 1 / 0.8); // edges lie on whole pixels of the screen
    const twice = views.zoomed(FRAME, 4, point, photoBox(once, FRAME));
    assertNear(under(point, twice, FRAME), before, 1 / 0.8 + 1 / 4);
  }
});

test("a zoom has limits", () => {
  const middle = { x: 420, y: 360 };
  const photo = photoBox(WHOLE, FRAME);
  assert.equal(views.zoomed(FRAME, 100, middle, photo).scale, 16);
  assert.equal(views.zoomed(FRAME, 0.1, middle, photo).scale, null); // the whole photograph
  assert.equal(views.zoomed(FRAME, 0.20001, middle, photo).scale, null);
  // A photograph that is smaller than the canvas can be shown at its full size, and at four times the size that fits.
  const small = photoBox(WHOLE, SMALL);
  assert.equal(views.zoomed(SMALL, 0.1, middle, small).scale, 1);
  assert.equal(views.zoomed(SMALL, 4, middle, small).scale, 4);
  const tiny = { ...SMALL, size: { width: 80, height: 60 } };
  assert.equal(views.zoomed(tiny, 100, middle, photoBox(WHOLE, tiny)).scale, 40);
});

test("a pan moves the photograph with the pointer", () => {
  const view = { scale: 2, x: 1000, y: 500 };
  assert.deepEqual(views.panned(view, FRAME, 30, -10), { scale: 2, x: 985, y: 505 });
  assert.deepEqual(views.panned(view, { ...FRAME, density: 2 }, 30, -10), { scale: 2, x: 970, y: 510 });
  assert.equal(views.panned(WHOLE, FRAME, 30, -10), WHOLE);
});

test("the buttons go through the scales and stop at the ends", () => {
  const scales = [];
  let view = WHOLE;
  for (let scale; (scale = views.nextScale(view, FRAME, 1)) !== undefined; view = { scale, x: 0, y: 0 }) {
    scales.push(scale);
  }
  assert.deepEqual(scales, [1 / 4, 1 / 2, 1, 2, 4, 8, 16]);
  scales.length = 0;
  for (let scale; (scale = views.nextScale(view, FRAME, -1)) !== undefined; view = { scale, x: 0, y: 0 }) {
    scales.push(scale);
  }
  assert.deepEqual(scales, [8, 4, 2, 1, 1 / 2, 1 / 4, 0.2]);
  assert.equal(views.nextScale(WHOLE, SMALL, -1), 2); // it fits at 4
  assert.equal(views.nextScale({ scale: 1, x: 0, y: 0 }, SMALL, -1), undefined);
});

test("the edges of the photograph lie on whole pixels of the screen", () => {
  const box = { left: 20.3, top: 60.7, width: 800.4, height: 600.2 };
  for (const density of [1, 1.5, 2]) {
    const frame = { ...FRAME, box, density };
    const { left, top } = photoBox({ scale: 1, x: 1000.2, y: 500.6 }, frame);
    assertNear([(left * density) % 1, (top * density) % 1].map((rest) => Math.min(rest, 1 - rest)), [0, 0], 1e-6);
  }
});

test("the wipe divides what is visible", () => {
  const view = { scale: 1, x: 1000, y: 500 };
  const { left, top, cut } = views.placement(view, FRAME, 25);
  assert.deepEqual([left, top], [600, 200]);
  assert.equal(cut, 20); // 600 + a quarter of 800, of 4000
  const narrow = { scale: 2, x: 100, y: 50 }; // the whole width of the small photograph is visible
  assert.equal(views.placement(narrow, SMALL, 25).cut, 25);
});

test("a piece lies in the photograph by shares of its size", () => {
  assert.deepEqual(views.styleOfPart([1000, 500, 3000, 1000], FRAME.size), {
    left: "25%",
    top: "25%",
    width: "50%",
    height: "25%",
  });
});
