/** What the page does beside zoom and pan: the question before it is left, and what its controls send to the server. */

/* global emitEvent -- of NiceGUI: sends an event to the server */

import { watchSliders } from "./sliders.js";

/** The page, as the server and the controls use it. */
class Page {
  /** Whether the edit has changed since a file was written; the server sets it. */
  isUnsaved = false;

  #takeFiles = null;

  /** Let a function take the first file that is dropped on the page, which the browser would leave the page for. */
  takeDropped(take) {
    if (!this.#takeFiles) {
      window.addEventListener("dragstart", (event) => event.target.matches?.("img") && event.preventDefault());
      window.addEventListener("dragover", (event) => event.preventDefault());
      window.addEventListener("drop", (event) => {
        event.preventDefault();
        if (event.dataTransfer.files.length && !document.querySelector(".q-dialog")) {
          this.#takeFiles([event.dataTransfer.files[0]]);
        }
      });
    }
    this.#takeFiles = take;
  }

  /** Leave without a question once the editor has ended: the edit is kept in a file. */
  watchConnection() {
    window.socket.on("disconnect", () => {
      this.isUnsaved = false;
    });
  }

  /** Show or hide the controls, on small screens. */
  fold() {
    document.documentElement.classList.toggle("folded");
  }

  /** Send a pointer on the photograph; moves without a pressed button are not sent. */
  point(event, emit) {
    if (event.buttons || event.mouse_event_type !== "pointermove") {
      emit([event.mouse_event_type, event.image_x, event.image_y]);
    }
  }

  /** Send why the browser refuses a file, and the name of the file. */
  refuse(entries, emit) {
    emit([entries[0].failedPropValidation, entries[0].file.name]);
  }

  /** Let the browser ask before it leaves a page whose edit has changed. */
  askBeforeLeaving() {
    window.addEventListener("beforeunload", (event) => {
      if (this.isUnsaved) {
        event.preventDefault();
        event.returnValue = "";
      }
    });
  }

  /** Ask for a name to save the photograph under on Ctrl+S, in place of the browser's dialog. */
  saveByKey() {
    window.addEventListener("keydown", (event) => {
      if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "s" && !event.shiftKey && !event.altKey) {
        event.preventDefault();
        if (!event.repeat && !document.querySelector(".q-dialog")) {
          emitEvent("save_photo");
        }
      }
    });
  }
}

window.page = new Page();
window.page.askBeforeLeaving();
window.page.saveByKey();
watchSliders();
