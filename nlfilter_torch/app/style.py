"""The style of the page; everything comes from here and from NiceGUI, nothing from the network."""

CSS = """
:root { --wipe: 0; }
body { background: #17181b; }
.nicegui-content { padding: 0 !important; gap: 0 !important; }
.topbar { background: #101114; height: 52px; gap: 6px; }
.dialog { min-width: 460px; background: #2a2d33; }
.editor { display: flex; width: 100vw; height: calc(100vh - 52px); }
.viewer { flex: 1; min-width: 0; display: flex; flex-direction: column; padding: 16px 20px 8px; gap: 10px; }
.canvas { flex: 1; min-height: 0; width: 100%; display: flex; align-items: center; justify-content: center; }
.photo { position: relative; box-shadow: 0 2px 24px #0009; user-select: none; touch-action: none; cursor: crosshair; }
.photo.still { cursor: default; }
.photo > svg { z-index: 2; }
.photo .over { position: absolute; inset: 0; width: 100%; height: 100%; pointer-events: none; }
.photo .before { clip-path: inset(0 calc(100% - var(--wipe) * 1%) 0 0); z-index: 3; }
.photo .edge { position: absolute; top: 0; bottom: 0; width: 2px; left: calc(var(--wipe) * 1% - 1px); background: #fff;
  opacity: min(1, var(--wipe)); pointer-events: none; z-index: 4; }
.photo .tag { position: absolute; top: 8px; left: 10px; padding: 1px 8px; border-radius: 9px; background: #000a;
  color: #fff; font-size: 12px; pointer-events: none; z-index: 4; opacity: min(1, var(--wipe)); }
.stroke { fill: none; stroke-linecap: round; stroke-linejoin: round; opacity: .6; }
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
.bar { width: 100%; color: #b9bcc4; gap: 14px; flex-wrap: nowrap; align-items: center; }
"""
