/** The frame of a crop while it is dragged. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { atLeast, moved } from "../../../../nlfilter_torch/photo/app/static/frames.js";

const ALL = ["left", "top", "right", "bottom"];
const close = (edges, wanted) => edges.forEach((edge, i) => assert.ok(Math.abs(edge - wanted[i]) < 1e-12, `${edges}`));

test("an edge follows the pointer, and stops at the border and before the other edge", () => {
  const frame = [0.2, 0.2, 0.8, 0.9];
  close(moved(frame, ["left"], 0.1, 0.5), [0.3, 0.2, 0.8, 0.9]);
  close(moved(frame, ["left"], -0.5, 0), [0, 0.2, 0.8, 0.9]);
  close(moved(frame, ["left"], 0.9, 0), [0.79, 0.2, 0.8, 0.9]);
  close(moved(frame, ["bottom"], 0.5, -0.9), [0.2, 0.2, 0.8, 0.21]);
  close(moved(frame, ["bottom", "right"], 0.1, 0.5), [0.2, 0.2, 0.9, 1]);
});

test("the whole frame keeps its size", () => {
  const frame = [0.2, 0.2, 0.8, 0.9];
  close(moved(frame, ALL, 0.1, -0.1), [0.3, 0.1, 0.9, 0.8]);
  close(moved(frame, ALL, 5, -5), [0.4, 0, 1, 0.7]);
});

test("a frame keeps its aspect: the opposite edge or corner stays, and the middle across", () => {
  const frame = [0.2, 0.3, 0.6, 0.7];
  close(moved(frame, ["right"], 0.2, 0.5, 1), [0.2, 0.2, 0.8, 0.8]);
  close(moved(frame, ["top"], 0.2, -0.2, 1), [0.1, 0.1, 0.7, 0.7]);
  close(moved(frame, ["left", "top"], -0.1, -0.05, 1), [0.1, 0.2, 0.6, 0.7]);
  close(moved(frame, ["bottom", "right"], 0.9, 0.9, 2), [0.2, 0.3, 1, 0.7]);
  close(moved([0, 0, 0.2, 0.2], ["right"], 0.9, 0, 0.5), [0, 0, 0.5, 1]); // moved into the picture
  close(moved(frame, ALL, 0.1, 0.1, 1), [0.3, 0.4, 0.7, 0.8]);
});

test("a frame is never empty", () => {
  close(atLeast([0.5, 0.5, 0.5, 0.5]), [0.5, 0.5, 0.505, 0.505]);
  close(atLeast([0, 0, 1, 1]), [0, 0, 1, 1]);
  close(atLeast([0.998, 0, 0.999, 1]), [0.995, 0, 1, 1]);
  assert.ok(atLeast([0.9995, 0.9995, 1, 1]).every((edge) => edge >= 0 && edge <= 1));
  close(moved([0.2, 0.2, 0.6, 0.4], ["left"], 0.9, 0, 2), [0.58, 0.295, 0.6, 0.305]);
});

test("no edge is beyond the border, not by rounding either", () => {
  const handles = [...ALL.map((name) => [name]), ["left", "top"], ["right", "top"], ["left", "bottom"], ["right", "bottom"]];
  for (const aspect of [null, 1, 3 / 2, 2 / 3, 4 / 3, 3 / 4, 16 / 9, 9 / 16, 0.37]) {
    for (let i = 1; i < 40; i++) {
      const frame = [i / 97, i / 61, 1 - i / 83, 1 - i / 71];
      for (const names of [...handles, ALL]) {
        for (const [right, down] of [[2, 2], [-2, -2], [2, -2], [-2, 2], [i / 53, -i / 59]]) {
          const edges = atLeast(moved(frame, names, right, down, aspect));
          assert.ok(edges.every((edge) => edge >= 0 && edge <= 1), `${edges}`);
          assert.ok(edges[0] < edges[2] && edges[1] < edges[3], `${edges}`);
        }
      }
    }
  }
});
