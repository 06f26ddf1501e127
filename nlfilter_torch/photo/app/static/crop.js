/**
 * The frame of the crop, which is dragged over the whole photograph.
 *
 * Edges are shares of the width and height, in the order left, top, right, bottom. The server is told the edges once the
 * pointer is released, or a moment after the last key, and sends back those that the photograph can have.
 */

/* global emitEvent -- of NiceGUI: sends an event to the server */

import { EDGES, atLeast, moved } from "./frames.js";

const REST = 400; // milliseconds after the last key
const STEP = 0.01; // of an arrow key
const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/** The frame on the page, as the server and the controls use it. */
class Cropper {
  #edges = [0, 0, 1, 1];
  #drag = null; // `{ edges, x, y, names }` where a drag began, and which edges it moves
  #timer = 0;
  #aspect = null; // that the frame keeps
  #isReady = false;

  /** Show a picture of that size, and a frame, which keeps an aspect unless that is null. */
  show(address, width, height, edges, aspect = null) {
    this.#aspect = aspect;
    document.documentElement.classList.add("cropping");
    this.#listen();
    const picture = document.querySelector(".crop-picture");
    picture.querySelector("img").src = address;
    picture.style.width = `min(100cqw, calc(100cqh * ${width / height}))`;
    picture.style.aspectRatio = `${width} / ${height}`;
    if (!this.#drag && !this.#timer) {
      this.#place(edges); // else it is an answer to edges of before
    }
  }

  /** Hide it. */
  hide() {
    document.documentElement.classList.remove("cropping");
    this.#drag = null;
    this.#stopTimer();
  }

  #listen() {
    if (this.#isReady) {
      return;
    }
    this.#isReady = true;
    const tool = document.querySelector(".cropper");
    tool.addEventListener("pointerdown", (event) => this.#begin(event));
    tool.addEventListener("pointermove", (event) => this.#continue(event));
    tool.addEventListener("pointerup", () => this.#end());
    tool.addEventListener("pointercancel", () => this.#end());
    window.addEventListener("keydown", (event) => this.#key(event), { capture: true });
  }

  #place(edges) {
    this.#edges = edges;
    const frame = document.querySelector(".crop-frame");
    const [left, top, right, bottom] = edges.map((edge) => 100 * edge);
    Object.assign(frame.style, {
      left: `${left}%`,
      top: `${top}%`,
      width: `${right - left}%`,
      height: `${bottom - top}%`,
    });
    for (const handle of frame.querySelectorAll("[data-edge]")) {
      const share = 100 * edges[EDGES.indexOf(handle.dataset.edge)];
      handle.setAttribute("aria-valuenow", share.toFixed(1));
      handle.setAttribute("aria-valuetext", `${share.toFixed(1)} %`);
    }
  }

  #begin(event) {
    const inFrame = event.target.closest(".crop-frame");
    if (!inFrame || event.button !== 0) {
      return;
    }
    event.preventDefault();
    event.target.focus?.();
    event.currentTarget.setPointerCapture(event.pointerId);
    const names = EDGES.filter((name) => event.target.classList.contains(name));
    this.#drag = { edges: this.#edges, x: event.clientX, y: event.clientY, names: names.length ? names : EDGES };
  }

  #continue(event) {
    if (!this.#drag) {
      return;
    }
    const box = document.querySelector(".crop-picture").getBoundingClientRect();
    const { edges, x, y, names } = this.#drag;
    this.#place(moved(edges, names, (event.clientX - x) / box.width, (event.clientY - y) / box.height, this.#aspect));
  }

  #end() {
    if (this.#drag) {
      this.#drag = null;
      this.#tell();
    }
  }

  #tell() {
    this.#stopTimer();
    emitEvent("crop", atLeast(this.#edges));
  }

  #stopTimer() {
    clearTimeout(this.#timer);
    this.#timer = 0;
  }

  #key(event) {
    const edge = event.target.dataset?.edge;
    // A question or an open list has the keys, but not a list that is fading since an edge has the focus.
    const isElsewhere = document.querySelector(edge ? ".q-dialog" : ".q-dialog, .q-menu") !== null;
    if (!document.documentElement.classList.contains("cropping") || isElsewhere) {
      return;
    }
    const way = KEYS[event.key];
    if (edge && way) {
      const step = event.shiftKey ? STEP / 10 : STEP;
      this.#place(moved(this.#edges, [edge], way[0] * step, way[1] * step, this.#aspect));
      clearTimeout(this.#timer);
      this.#timer = setTimeout(() => this.#tell(), REST);
    } else if (event.key === "Escape" || (event.key === "Enter" && edge)) {
      if (this.#timer) {
        this.#tell();
      }
      emitEvent("crop_done");
    } else {
      return;
    }
    event.stopPropagation();
    event.preventDefault();
  }
}

window.cropper = new Cropper();
