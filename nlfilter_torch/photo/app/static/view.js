/**
 * The geometry of zoom and pan, without the page: which part of a photograph is seen, and where it lies.
 *
 * A view is `{ scale, x, y }`: how many pixels of the screen show one pixel of the photograph, or null while the whole
 * photograph is shown, and the point of the photograph in the middle of the canvas. A frame says what a view is seen
 * through: `size` of the photograph, `room` that the canvas has for it (both `{ width, height }`), the `box` of the
 * canvas on the page (`{ left, top, width, height }`), and `density`, pixels of the screen per pixel of the page.
 */

/** The view of the whole photograph. */
export const WHOLE = { scale: null, x: 0, y: 0 };

const CLOSE = 0.5; // the scale from which on a part is shown at full size
const MOST = 16;
const LADDER = [1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1, 2, 4, 8, 16];

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

/** The scale at which the whole photograph fits the canvas. */
export function fittingScale({ size, room, density }) {
  return Math.min(room.width / size.width, room.height / size.height) * density;
}

/** The scale of a view. */
export function scaleOf(view, frame) {
  return view.scale ?? fittingScale(frame);
}

/** Whether a view shows its part at full size. */
export function isCloseup(view) {
  return view.scale !== null && view.scale >= CLOSE;
}

/** Left, top, right and bottom of the visible part, in pixels of the photograph. */
export function visiblePart(view, frame) {
  const { size, room, density } = frame;
  const scale = scaleOf(view, frame) / density;
  const halfWidth = room.width / scale / 2;
  const halfHeight = room.height / scale / 2;
  return [
    Math.max(0, Math.floor(view.x - halfWidth)),
    Math.max(0, Math.floor(view.y - halfHeight)),
    Math.min(size.width, Math.ceil(view.x + halfWidth)),
    Math.min(size.height, Math.ceil(view.y + halfHeight)),
  ];
}

/** The middle of what is visible of a length, so that nothing beyond its ends is. */
function held(middle, length, visible) {
  return visible >= length ? length / 2 : clamp(middle, visible / 2, length - visible / 2);
}

/** The view, moved so that nothing beyond the border of the photograph is visible. */
export function withinBorders(view, frame) {
  const { size, box, density } = frame;
  const scale = scaleOf(view, frame) / density;
  const middle = view.scale === null ? { x: size.width / 2, y: size.height / 2 } : view;
  return {
    scale: view.scale,
    x: held(middle.x, size.width, box.width / scale),
    y: held(middle.y, size.height, box.height / scale),
  };
}

/** How far an edge on the page is from the next whole pixel of the screen. */
function rest(edge, density) {
  return Math.round(edge * density) / density - edge;
}

/**
 * Where the photograph lies, for a view within its borders, in pixels of the page.
 *
 * The photograph has a `width` and `height`, and is moved to the `right` and `down` from the middle of the canvas.
 * `left` and `top` are the distances of the visible part from its edges, and `cut` is where the border between before and
 * after lies, in hundredths of the width, if it divides the visible part at `wipe` hundredths.
 */
export function placement(view, frame, wipe) {
  const { size, box, density } = frame;
  const scale = scaleOf(view, frame) / density;
  const width = size.width * scale;
  const height = size.height * scale;
  if (view.scale === null) {
    return { width, height, right: 0, down: 0, left: 0, top: 0, cut: wipe };
  }
  let right = (size.width / 2 - view.x) * scale;
  let down = (size.height / 2 - view.y) * scale;
  right += rest(box.left + (box.width - width) / 2 + right, density);
  down += rest(box.top + (box.height - height) / 2 + down, density);
  const left = Math.max(0, (width - box.width) / 2 - right);
  const top = Math.max(0, (height - box.height) / 2 - down);
  const cut = (100 * (left + (Math.min(width, box.width) * wipe) / 100)) / width;
  return { width, height, right, down, left, top, cut };
}

/**
 * The view at another scale, in which the photograph stays where it is under a point of the page.
 *
 * `photo` is the box of the photograph on the page. Scales have limits; at the lower one the whole photograph is shown.
 */
export function zoomed(frame, scale, point, photo) {
  const { size, box, density } = frame;
  const all = fittingScale(frame);
  const next = clamp(scale, Math.min(all, 1), Math.max(MOST, 4 * all));
  const underX = ((point.x - photo.left) / photo.width) * size.width;
  const underY = ((point.y - photo.top) / photo.height) * size.height;
  return {
    scale: all < 1 && next <= all * 1.001 ? null : next,
    x: underX - ((point.x - box.left - box.width / 2) * density) / next,
    y: underY - ((point.y - box.top - box.height / 2) * density) / next,
  };
}

/** The view after the photograph was moved by pixels of the page; the whole photograph does not move. */
export function panned(view, frame, right, down) {
  if (view.scale === null) {
    return view;
  }
  const { density } = frame;
  return {
    scale: view.scale,
    x: view.x - (right * density) / view.scale,
    y: view.y - (down * density) / view.scale,
  };
}

/** The next scale that the buttons offer, larger if `direction` is positive and smaller otherwise, or undefined. */
export function nextScale(view, frame, direction) {
  const all = fittingScale(frame);
  const now = scaleOf(view, frame);
  const scales = [...LADDER, all].filter((scale) => scale >= Math.min(all, 1)).sort((a, b) => a - b);
  if (direction > 0) {
    return scales.find((scale) => scale > now * 1.01);
  }
  return scales.findLast((scale) => scale < now * 0.99);
}

/** Where a part of the photograph lies in it, as properties of a style. */
export function styleOfPart([left, top, right, bottom], size) {
  return {
    left: `${(100 * left) / size.width}%`,
    top: `${(100 * top) / size.height}%`,
    width: `${(100 * (right - left)) / size.width}%`,
    height: `${(100 * (bottom - top)) / size.height}%`,
  };
}
