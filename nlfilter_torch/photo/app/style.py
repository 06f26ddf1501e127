"""The style of the page; everything comes from here and from NiceGUI, nothing from the network."""

CSS = """
:root { --wipe: 0; --cut: 0; }
body { background: #17181b; }
.q-btn.bg-primary { --q-primary: #2f6fae; }  /* white on it can be read */
.nicegui-content { padding: 0 !important; gap: 0 !important; }
:focus-visible, .q-slider:focus-within:has(:focus-visible) {
  box-shadow: 0 0 0 2px #17181b, 0 0 0 4px #ffd54a !important; border-radius: 3px; }
.topbar { background: #101114; height: 52px; gap: 6px; padding: 0 16px; }
.title { min-width: 0; }
.dialog { width: 460px; max-width: 94vw; background: #2a2d33; }
.editor { display: flex; width: 100vw; height: calc(100dvh - 52px); }
.viewer { flex: 1; min-width: 0; display: flex; flex-direction: column; padding: 16px 20px 8px; gap: 10px; }
.canvas { flex: 1; min-height: 0; width: 100%; display: flex; align-items: center; justify-content: center;
  container-type: size; position: relative; touch-action: none; }
.zoomed .canvas { overflow: hidden; }
.photo { position: relative; flex: none; height: var(--photo-height, auto);
  transform: translate(var(--right, 0px), var(--down, 0px));
  box-shadow: 0 2px 24px #0009; user-select: none; touch-action: none; cursor: crosshair; }
.photo.still { cursor: default; }
.photo > svg { z-index: 2; }
.photo .over { position: absolute; inset: 0; width: 100%; height: 100%; pointer-events: none; }
.photo .before { clip-path: inset(0 calc(100% - var(--cut) * 1%) 0 0); z-index: 3; }
.photo .pieces, .photo .originals { visibility: hidden; }
.pieced .photo .pieces, .pieced .photo .originals { visibility: visible; }
.photo .pieces img, .photo .originals img { position: absolute; }
.coarse .photo .pieces img, .coarse .photo .originals img { image-rendering: pixelated; }
.zoomed.brushless .photo, .hand .photo { cursor: grab; }
.zoom { position: absolute; right: 6px; bottom: 6px; z-index: 6; display: flex; align-items: center; gap: 2px;
  padding: 2px 4px; border-radius: 10px; background: #101114d9; color: #dfe1e6; font-size: 12px; }
.zoom .q-btn { min-width: 32px; min-height: 32px; padding: 0; }
.zoom-level { min-width: 44px; text-align: center; font-variant-numeric: tabular-nums; }
.hand .zoom .grab { background: #3b4d6b; }
.photo .edge { position: absolute; top: 0; bottom: 0; width: 2px; left: calc(var(--cut) * 1% - 1px); background: #fff;
  opacity: min(1, var(--wipe)); pointer-events: none; z-index: 4; }
.photo .tag { position: absolute; top: calc(var(--top, 0px) + 8px); left: calc(var(--left, 0px) + 10px);
  padding: 1px 8px; border-radius: 9px; background: #000a;
  color: #fff; font-size: 12px; pointer-events: none; z-index: 4; opacity: min(1, var(--wipe)); }
.stroke { fill: none; stroke-linecap: round; stroke-linejoin: round; opacity: .6; }
@keyframes flash-0 { 70% { opacity: 1; } 100% { opacity: 0; visibility: hidden; } }
@keyframes flash-1 { 70% { opacity: 1; } 100% { opacity: 0; visibility: hidden; } }
.flash-0 { animation: flash-0 1.4s forwards; }
.flash-1 { animation: flash-1 1.4s forwards; }
.welcome { text-align: center; color: #b9bcc4; border: 2px dashed #44474f; border-radius: 12px; padding: 60px 80px; }
.panel { width: 376px; overflow-y: auto; background: #212328; padding: 4px 12px 18px; color: #dfe1e6; gap: 2px; }
.panel .q-tabs__content { display: grid; grid-template-columns: repeat(4, 1fr); }
.panel .q-tabs__arrow { display: none; }
.panel .q-tab { min-height: 36px; padding: 0 6px; }
.panel .q-tab-panel { padding: 10px 8px 14px; }
.hint { font-size: 12px; color: #9aa0aa; line-height: 1.35; }
.group { font-size: 12px; text-transform: uppercase; letter-spacing: .06em; color: #9aa0aa; margin-top: 10px; }
.control { width: 100%; margin-bottom: -6px; }
.control .value { font-variant-numeric: tabular-nums; color: #aeb4bf; }
.response { width: 100%; background: #1a1c20; border-radius: 8px; }
.response text { fill: #9aa0aa; font-size: 9px; }
.response .grid { stroke: #34373e; } .response .unit { stroke: #777c86; stroke-dasharray: 3 3; }
.response .mark { stroke: #9aa0aa; stroke-width: .7; } .response .curve { fill: none; stroke-width: 1.8; }
.histogram { width: 100%; height: 60px; background: #1a1c20; border-radius: 8px; }
.bins { fill-opacity: .25; stroke-width: 1; vector-effect: non-scaling-stroke; }
.hint.warning { color: #fbbf24; }
.handle { display: none; }
.bar { width: 100%; color: #b9bcc4; gap: 14px; flex-wrap: nowrap; align-items: center; }
@media (max-width: 1100px) {
  .topbar .wide { display: none; }
  .topbar .q-btn .block { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); }
  .topbar .q-btn .on-left { margin-right: 0; }
  .topbar { gap: 2px; padding: 0 8px; }
  .topbar .q-btn { min-width: 40px; min-height: 40px; }
  .bar .wide { display: none; }
  .zoom .q-btn { min-width: 38px; min-height: 38px; }
  .bar { padding-left: 12px; }
  .working { position: fixed; top: 58px; left: 10px; background: #000c; padding: 4px 10px; border-radius: 14px; }
  .panel { width: 300px; flex-wrap: nowrap; }
  .panel > * { flex: none; }
  .viewer { padding: 10px 10px 6px; }
}
@media (max-width: 700px) {
  .editor { flex-direction: column; }
  .viewer { padding: 6px; gap: 4px; min-height: 0; }
  .bar { gap: 8px; padding: 0 4px 0 12px; }
  .welcome { padding: 24px; }
  .panel { width: 100%; height: 44%; flex-wrap: nowrap; border-radius: 14px 14px 0 0; padding: 0 8px 12px; }
  .folded .panel { height: 40px; overflow: hidden; }
  .handle { display: inline-flex; width: 100%; min-height: 36px; flex: none; position: sticky; top: 0; z-index: 5;
    background: #212328; }
  .panel .control { margin-bottom: 0; }
}
"""
