/**
 * What the page does by itself: zoom, pan, the wipe, and where the pieces at full size lie.
 *
 * The size and place of the photograph follow from custom properties, and its overlays and scribbles follow it. The server
 * is told which part is visible once that has stayed the same for a moment, and sends pieces of it.
 */

/* global emitEvent -- of NiceGUI: sends an event to the server */

import { actionOfKey, Gestures, wheelFactor } from "./gestures.js";
import * as views from "./view.js";

const REST = 60; // milliseconds without a change, after which the server is told
const TYPED = "input:not([type=checkbox]), textarea, select, [contenteditable], .q-dialog, .q-menu";
const MOVED_BY_ARROWS = "[role=slider], .q-slider, [role=tab], [role=combobox], [role=listbox], [role=radio]";

const root = document.documentElement;
const canvas = () => document.querySelector(".canvas");

function consume(event) {
  event.stopPropagation();
  event.preventDefault();
}

/** The photograph on the page, as the server and the controls use it. */
class Closeup {
  #size = null; // of the photograph, once there is one
  #address = ""; // of its pictures
  #view = views.WHOLE;
  #wipe = 0;
  #isOriginal = false; // whether a key that shows the original is held
  #hasBrush = true;
  #gestures = new Gestures();
  #timer = 0;
  #told = ""; // the part that the server was told last
  #watched = null; // the canvas whose size is watched

  // For the server

  /** Show a photograph of that size, whose pictures are under an address. */
  open(width, height, address) {
    this.#size = { width, height };
    this.#address = address;
    this.#told = "";
    this.clear();
    const originals = document.querySelector(".originals");
    originals.replaceChildren();
    originals.dataset.shown = "";
    this.fit();
  }

  /** Add a piece by its name, at a place in pixels of the photograph; one that is only near lies below all others. */
  add(name, ...part) {
    const parent = document.querySelector(".pieces");
    const image = this.#picture(`${this.#address}/${name}`, part);
    image.addEventListener("load", () => {
      if (!name.startsWith("near")) {
        parent.append(image);
        return;
      }
      parent.querySelector('[data-name*="/near-"]')?.remove();
      parent.prepend(image);
    });
  }

  /** Remove a piece. */
  drop(name) {
    document.querySelector(`.pieces [data-name="${this.#address}/${name}"]`)?.remove();
  }

  /** Remove all pieces. */
  clear() {
    document.querySelector(".pieces")?.replaceChildren();
  }

  /** Set whether a pointer draws. */
  brush(hasBrush) {
    this.#hasBrush = hasBrush;
    root.classList.toggle("brushless", !hasBrush);
  }

  // For the controls

  /** Show the photograph before the edit in that many hundredths of what is visible. */
  wipe(share) {
    this.#wipe = share;
    this.#draw();
  }

  /** Show the photograph before the edit, or again as the wipe has it. */
  original(isShown) {
    if (this.#isOriginal !== isShown) {
      this.#isOriginal = isShown;
      this.#draw();
    }
  }

  /** Take the tool that draws scribbles with a role. */
  tool(role) {
    emitEvent("tool", role);
  }

  /** Hundredths of what is visible that show the photograph before the edit. */
  get #before() {
    return this.#isOriginal ? 100 : this.#wipe;
  }

  /** Zoom to the next larger (1) or smaller (-1) scale. */
  step(direction) {
    if (!this.#size) {
      return;
    }
    const scale = views.nextScale(this.#view, this.#frame(), direction);
    if (scale !== undefined) {
      this.#zoom(scale);
    }
  }

  /** Show the whole photograph. */
  fit() {
    this.#view = views.WHOLE;
    this.#draw();
  }

  /** Show one pixel of the photograph on each of the screen. */
  full() {
    this.#zoom(1);
  }

  /** Let the pointer move the photograph in place of drawing, or no longer; without an argument, switch. */
  hand(isOn) {
    const isPressed = root.classList.toggle("hand", isOn);
    document.querySelector(".zoom .grab")?.setAttribute("aria-pressed", isPressed);
  }

  // Zoom and pan

  #frame() {
    const element = canvas();
    return {
      size: this.#size,
      room: { width: element.clientWidth, height: element.clientHeight },
      box: element.getBoundingClientRect(),
      density: window.devicePixelRatio || 1,
    };
  }

  /** Zoom to a scale, with the photograph held under a point, by default the middle of the canvas. */
  #zoom(scale, point = null) {
    if (!this.#size) {
      return;
    }
    const frame = this.#frame();
    const { left, top, width, height } = frame.box;
    const photo = document.querySelector(".photo").getBoundingClientRect();
    this.#view = views.zoomed(frame, scale, point ?? { x: left + width / 2, y: top + height / 2 }, photo);
    this.#draw();
  }

  #zoomBy(factor, point) {
    this.#zoom(views.scaleOf(this.#view, this.#frame()) * factor, point);
  }

  #pan(right, down) {
    const view = views.panned(this.#view, this.#frame(), right, down);
    if (view !== this.#view) {
      this.#view = view;
      this.#draw();
    }
  }

  // What is shown

  #draw() {
    if (!this.#size || !canvas()) {
      return;
    }
    this.#watch();
    const photo = this.#watched.querySelector(".photo > img");
    if (photo && !photo.alt) {
      photo.alt = "photograph";
    }
    const frame = this.#frame();
    this.#view = views.withinBorders(this.#view, frame);
    this.#place(views.placement(this.#view, frame, this.#before));
    const level = document.querySelector(".zoom-level");
    if (level) {
      level.textContent = `${Math.round(100 * views.scaleOf(this.#view, frame))} %`;
    }
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#tell(), REST);
  }

  /** Draw again whenever the size of the canvas changes. */
  #watch() {
    if (this.#watched !== canvas()) {
      this.#watched = canvas();
      new ResizeObserver(() => this.#draw()).observe(this.#watched);
    }
  }

  /** Set the classes and properties that page.css uses. */
  #place({ width, height, right, down, left, top, cut }) {
    const { scale } = this.#view;
    const isZoomed = scale !== null;
    root.classList.toggle("zoomed", isZoomed);
    root.classList.toggle("pieced", views.isCloseup(this.#view));
    root.classList.toggle("coarse", isZoomed && scale >= 2);
    const properties = {
      "--photo-width": isZoomed ? `${width}px` : "",
      "--photo-height": isZoomed ? `${height}px` : "",
      "--right": `${right}px`,
      "--down": `${down}px`,
      "--cut": cut,
      "--wipe": this.#before,
      "--left": `${left}px`,
      "--top": `${top}px`,
    };
    for (const [name, value] of Object.entries(properties)) {
      root.style.setProperty(name, value);
    }
  }

  /** Tell the server which part is visible, and show that part of the original if the wipe needs it. */
  #tell() {
    const part = views.isCloseup(this.#view) ? views.visiblePart(this.#view, this.#frame()) : null;
    const text = JSON.stringify(part);
    if (text !== this.#told) {
      this.#told = text;
      emitEvent("closeup", part);
    }
    if (part && this.#before > 0) {
      this.#showOriginal(part);
    }
  }

  /** Replace the part of the original that is shown, once the new one is there. */
  #showOriginal(part) {
    const parent = document.querySelector(".originals");
    const source = `${this.#address}/original?at=${part.join(",")}`;
    if (parent.dataset.shown === source) {
      return;
    }
    parent.dataset.shown = source;
    const image = this.#picture(source, part);
    image.addEventListener("load", () => {
      if (parent.dataset.shown === source) {
        parent.replaceChildren(image);
      }
    });
  }

  /** A picture of a part of the photograph, which is being loaded. */
  #picture(source, part) {
    const image = new Image();
    image.alt = "";
    image.draggable = false;
    image.dataset.name = source;
    Object.assign(image.style, views.styleOfPart(part, this.#size));
    image.src = source;
    return image;
  }

  // Pointers and keys

  /** Listen to the pointers, the wheel and the keyboard, before the elements of the page do. */
  listen() {
    document.addEventListener("pointerdown", (event) => this.#down(event), true);
    document.addEventListener("pointermove", (event) => this.#move(event), true);
    document.addEventListener("pointerup", (event) => this.#up(event), true);
    document.addEventListener("pointercancel", (event) => this.#up(event), true);
    document.addEventListener("wheel", (event) => this.#turn(event), { capture: true, passive: false });
    document.addEventListener("keydown", (event) => this.#press(event));
    document.addEventListener("keyup", (event) => this.#release(event));
    window.addEventListener("blur", () => this.original(false));
  }

  #isOnCanvas(event) {
    return this.#size && event.target.closest?.(".canvas") && !event.target.closest(".zoom, .cropper");
  }

  #down(event) {
    if (!this.#isOnCanvas(event)) {
      return;
    }
    const pointer = { id: event.pointerId, x: event.clientX, y: event.clientY, button: event.button };
    const draws = this.#hasBrush && !root.classList.contains("hand");
    if (this.#gestures.down(pointer, draws)) {
      emitEvent("stroke_dropped"); // it was the first of two fingers
    }
    if (this.#gestures.isTaken) {
      consume(event);
      canvas().setPointerCapture(event.pointerId);
    }
  }

  #move(event) {
    const pointer = { id: event.pointerId, x: event.clientX, y: event.clientY, buttons: event.buttons };
    const change = this.#gestures.move(pointer);
    if (change === null) {
      return;
    }
    consume(event);
    if (change.zoom) {
      this.#zoomBy(change.zoom.factor, change.zoom);
    }
    this.#pan(change.right, change.down);
  }

  #up(event) {
    if (this.#gestures.up({ id: event.pointerId })) {
      consume(event);
    }
  }

  #turn(event) {
    if (this.#isOnCanvas(event)) {
      consume(event);
      this.#zoomBy(wheelFactor(event), { x: event.clientX, y: event.clientY });
    }
  }

  #press(event) {
    const target = event.target.closest ? event.target : document.body;
    const isShortcut = event.ctrlKey || event.metaKey || event.altKey;
    if (!this.#size || isShortcut || target.closest(TYPED)) {
      return;
    }
    const [name, ...values] = actionOfKey(event.key, canvas().clientWidth) ?? [];
    if (name && this.#isFor(name, target)) {
      this.#act(name, values);
      event.preventDefault();
    }
  }

  #release(event) {
    const [name] = actionOfKey(event.key, 0) ?? [];
    if (name === "hand" || name === "original") {
      this[name](false);
    }
  }

  /** Whether an action of a key is meant for the photograph, and not for the element that has the focus. */
  #isFor(name, target) {
    switch (name) {
      case "pan":
        return this.#view.scale !== null && !target.closest(MOVED_BY_ARROWS);
      case "hand":
        return target === document.body || target.closest(".canvas") !== null;
      default:
        return true;
    }
  }

  #act(name, values) {
    if (name === "pan") {
      this.#pan(...values);
    } else {
      this[name](...values); // step, fit, full, hand, original, tool
    }
  }
}

window.closeup = new Closeup();
window.closeup.listen();
