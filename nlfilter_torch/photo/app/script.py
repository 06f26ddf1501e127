"""What the page does by itself: zoom, pan, the wipe, and where the pieces at full size lie.

The photograph is an element whose size and place follow from two numbers that custom properties hold; its overlays and
scribbles follow it. The server is told which part is seen, once that rests, and sends pieces of it.
"""

SCRIPT = """<script>
window.closeup = (() => {
  const LEAST = 0.5, MOST = 16, REST = 60;  // scale from which on pieces are asked for; milliseconds
  const LADDER = [1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1, 2, 4, 8, 16];
  const root = document.documentElement, fingers = new Map();
  let size = null, address = "", scale = null, x = 0, y = 0;  // device pixels for each of the photograph, or null: all
  let wipe = 0, brush = true, gesture = null, timer = 0, told = "", watched = null;
  const canvas = () => document.querySelector(".canvas");
  const density = () => window.devicePixelRatio || 1;
  const whole = () => Math.min(canvas().clientWidth / size.width, canvas().clientHeight / size.height) * density();
  const now = () => scale ?? whole();
  const set = (name, value) => root.style.setProperty(name, value);

  function seen() {  // left, top, right, bottom in pixels of the photograph
    const s = now() / density(), width = canvas().clientWidth / s, height = canvas().clientHeight / s;
    return [Math.max(0, Math.floor(x - width / 2)), Math.max(0, Math.floor(y - height / 2)),
      Math.min(size.width, Math.ceil(x + width / 2)), Math.min(size.height, Math.ceil(y + height / 2))];
  }

  function hold(at, length, visible) {  // the middle of what is seen, with nothing beyond the border
    return visible >= length ? length / 2 : Math.min(Math.max(at, visible / 2), length - visible / 2);
  }

  function draw() {
    if (!size || !canvas()) return;
    if (watched !== canvas()) {
      watched = canvas();
      new ResizeObserver(draw).observe(watched);
    }
    const photo = watched.querySelector(".photo > img");
    if (photo && !photo.alt) photo.alt = "photograph";
    const box = watched.getBoundingClientRect(), s = now() / density();
    const width = size.width * s, height = size.height * s;
    if (scale === null) { x = size.width / 2; y = size.height / 2; }
    x = hold(x, size.width, box.width / s);
    y = hold(y, size.height, box.height / s);
    const rest = (edge) => Math.round(edge * density()) / density() - edge;  // whole pixels of the screen
    let right = (size.width / 2 - x) * s, down = (size.height / 2 - y) * s;
    right += rest(box.left + (box.width - width) / 2 + right);
    down += rest(box.top + (box.height - height) / 2 + down);
    root.classList.toggle("zoomed", scale !== null);
    root.classList.toggle("pieced", scale !== null && scale >= LEAST);
    root.classList.toggle("coarse", scale !== null && scale >= 2);
    set("--photo-width", scale === null ? "" : `${width}px`);
    set("--photo-height", scale === null ? "" : `${height}px`);
    set("--right", scale === null ? "0px" : `${right}px`);
    set("--down", scale === null ? "0px" : `${down}px`);
    const left = scale === null ? 0 : Math.max(0, (width - box.width) / 2 - right);
    const shown = scale === null ? width : Math.min(width, box.width);
    set("--cut", 100 * (left + shown * wipe / 100) / width);
    set("--wipe", wipe);
    set("--left", `${left}px`);
    set("--top", scale === null ? "0px" : `${Math.max(0, (height - box.height) / 2 - down)}px`);
    const level = document.querySelector(".zoom-level");
    if (level) level.textContent = `${Math.round(100 * now())} %`;
    clearTimeout(timer);
    timer = setTimeout(tell, REST);
  }

  function tell() {
    const view = scale !== null && scale >= LEAST ? seen() : null;
    const text = JSON.stringify(view);
    if (text !== told) { told = text; emitEvent("closeup", view); }
    if (view && wipe > 0) place(".originals", `${address}/original?at=${view.join(",")}`, view, true);
  }

  function place(selector, source, [left, top, right, bottom], alone) {
    const parent = document.querySelector(selector), image = new Image();
    if (alone && parent.dataset.shown === source) return;
    parent.dataset.shown = source;
    image.alt = "";
    image.draggable = false;
    image.dataset.name = source;
    Object.assign(image.style, { left: `${100 * left / size.width}%`, top: `${100 * top / size.height}%`,
      width: `${100 * (right - left) / size.width}%`, height: `${100 * (bottom - top) / size.height}%` });
    image.onload = () => {
      if (alone && parent.dataset.shown !== source) return;
      if (alone) parent.replaceChildren();
      parent.append(image);
    };
    image.src = source;
  }

  function zoom(wanted, clientX, clientY) {  // with what is under a point held
    if (!size) return;
    const box = canvas().getBoundingClientRect(), photo = document.querySelector(".photo").getBoundingClientRect();
    clientX ??= box.left + box.width / 2;
    clientY ??= box.top + box.height / 2;
    const all = whole(), next = Math.min(Math.max(wanted, Math.min(all, 1)), Math.max(MOST, 4 * all));
    const s = next / density();
    const underX = (clientX - photo.left) / photo.width * size.width;
    const underY = (clientY - photo.top) / photo.height * size.height;
    scale = all < 1 && next <= all * 1.001 ? null : next;
    x = underX - (clientX - box.left - box.width / 2) / s;
    y = underY - (clientY - box.top - box.height / 2) / s;
    draw();
  }

  function pan(right, down) {  // in pixels of the page
    if (!size || scale === null) return;
    x -= right * density() / scale;
    y -= down * density() / scale;
    draw();
  }

  function step(direction) {
    if (!size) return;
    const all = whole(), steps = [...LADDER, all].filter((s) => s >= Math.min(all, 1)).sort((a, b) => a - b);
    const next = direction > 0 ? steps.find((s) => s > now() * 1.01) : steps.findLast((s) => s < now() * 0.99);
    if (next) zoom(next);
  }

  function fit() { scale = null; draw(); }

  const on = (event) => size && event.target.closest?.(".canvas") && !event.target.closest(".zoom");
  const take = (event) => { event.stopPropagation(); event.preventDefault(); };
  const middle = () => {
    const [a, b] = [...fingers.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(a.x - b.x, a.y - b.y) || 1 };
  };

  function down(event) {
    if (!on(event)) return;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (fingers.size > 1) {
      if (gesture === null) emitEvent("stroke_dropped");  // it was the first of two fingers
      gesture = "pinch";
    } else if (event.button === 1 || (event.button === 0 && (!brush || root.classList.contains("hand")))) {
      gesture = "pan";
    }
    if (gesture) { take(event); canvas().setPointerCapture(event.pointerId); }
  }

  function move(event) {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    if (event.buttons === 0) { fingers.delete(event.pointerId); gesture = null; return; }
    const before = fingers.size > 1 ? middle() : null;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (!gesture) return;
    take(event);
    if (gesture === "pan") pan(event.clientX - last.x, event.clientY - last.y);
    if (gesture === "pinch" && before) {
      const after = middle();
      zoom(now() * after.apart / before.apart, before.x, before.y);
      pan(after.x - before.x, after.y - before.y);
    }
  }

  function up(event) {
    if (!fingers.delete(event.pointerId) || !gesture) return;
    take(event);
    if (fingers.size === 0) gesture = null;
    else gesture = "done";  // the finger that is left draws nothing
  }

  function wheel(event) {
    if (!on(event)) return;
    take(event);
    const lines = event.deltaMode === 1 ? 24 : 1;
    zoom(now() * Math.exp(-event.deltaY * lines * (event.ctrlKey ? 0.01 : 0.002)), event.clientX, event.clientY);
  }

  const TYPED = "input:not([type=checkbox]), textarea, select, [contenteditable], .q-dialog, .q-menu";
  const MOVED = "[role=slider], .q-slider, [role=tab], [role=combobox], [role=listbox], [role=radio]";
  function key(event) {
    const target = event.target.closest ? event.target : document.body;
    if (!size || event.ctrlKey || event.metaKey || event.altKey || target.closest(TYPED)) return;
    const far = 0.15 * canvas().clientWidth;
    const arrows = { ArrowLeft: [far, 0], ArrowRight: [-far, 0], ArrowUp: [0, far], ArrowDown: [0, -far] };
    if (event.key === "+" || event.key === "=") step(1);
    else if (event.key === "-" || event.key === "_") step(-1);
    else if (event.key === "0") fit();
    else if (event.key === "1") zoom(1);
    else if (event.key in arrows && scale !== null && !target.closest(MOVED)) pan(...arrows[event.key]);
    else if (event.key === " " && (target === document.body || target.closest(".canvas"))) hand(true);
    else return;
    event.preventDefault();
  }

  function hand(on) {
    const held = root.classList.toggle("hand", on);
    document.querySelector(".zoom .grab")?.setAttribute("aria-pressed", held);
  }

  document.addEventListener("pointerdown", down, true);
  document.addEventListener("pointermove", move, true);
  document.addEventListener("pointerup", up, true);
  document.addEventListener("pointercancel", up, true);
  document.addEventListener("wheel", wheel, { capture: true, passive: false });
  document.addEventListener("keydown", key);
  document.addEventListener("keyup", (event) => { if (event.key === " ") hand(false); });
  return {
    open(width, height, at) {
      size = { width, height };
      address = at;
      told = "";
      this.clear();
      document.querySelector(".originals").replaceChildren();
      fit();
    },
    add(name, ...place_) { place(".pieces", `${address}/${name}`, place_, false); },
    drop(name) { document.querySelector(`.pieces [data-name="${address}/${name}"]`)?.remove(); },
    clear() { document.querySelector(".pieces")?.replaceChildren(); },
    brush(on) { brush = on; root.classList.toggle("brushless", !on); },
    wipe(share) { wipe = share; draw(); },
    step, fit, hand, full: () => zoom(1),
  };
})();
</script>"""
