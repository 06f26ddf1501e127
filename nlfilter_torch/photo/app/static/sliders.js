/**
 * Sliders for screen readers: the part of a slider that takes the focus has its role, name and value.
 *
 * Quasar gives these to the element around that part, where nobody who tabs to the slider hears them.
 */

const MOVED = ["role", "aria-label", "aria-orientation", "aria-valuemin", "aria-valuemax", "aria-valuenow"];

/** Move what describes a slider to its part that takes the focus. */
export function describe(slider) {
  const part = slider.querySelector(".q-slider__track-container");
  if (!part) {
    return;
  }
  for (const name of MOVED) {
    if (slider.hasAttribute(name)) {
      part.setAttribute(name, slider.getAttribute(name));
      slider.removeAttribute(name);
    }
  }
}

/** Describe all sliders of the page, now and whenever one is added or changes. */
export function watchSliders() {
  const describeAll = () => document.querySelectorAll(".q-slider:is([role], [aria-valuenow])").forEach(describe);
  const options = { childList: true, subtree: true, attributes: true, attributeFilter: ["aria-valuenow", "role"] };
  new MutationObserver(describeAll).observe(document.body, options);
  describeAll();
}
