/** What the page does beside zoom and pan: the question before it is left, and what its controls send to the server. */

/* global emitEvent, getElement -- of NiceGUI: send an event to the server; the component of an element */

import { watchSliders } from "./sliders.js";

/** Names of the files that are loaded as edits or looks. */
const EDITS = /\.(json|cube)$/iu;

/** Whether a file is a photograph; browsers know no type of HEIC files. */
const isPhotograph = (file) => file.type.startsWith("image/") || /\.hei[cf]$/iu.test(file.name);

/** The page, as the server and the controls use it. */
class Page {
  /** Whether the edit has changed since a file was written; the server sets it. */
  isUnsaved = false;

  #photographs = null;

  /** Take files that are dropped on the page, which the browser would leave the page for: photographs by an upload. */
  takeDropped(photographs) {
    if (!this.#photographs) {
      const hasFiles = (event) => event.dataTransfer?.types.includes("Files");
      window.addEventListener("dragstart", (event) => event.target.matches?.("img") && event.preventDefault());
      window.addEventListener("dragover", (event) => hasFiles(event) && event.preventDefault());
      window.addEventListener("drop", (event) => {
        if (hasFiles(event)) {
          event.preventDefault();
          this.#take([...event.dataTransfer.files]);
        }
      });
    }
    this.#photographs = photographs;
  }

  /** Send the photographs of some files, or else the first edit, and tell the upload what is not opened. */
  #take(files) {
    const photographs = files.filter(isPhotograph);
    const file = photographs[0] ?? files.find(({ name }) => EDITS.test(name)) ?? files[0];
    if (!file) {
      return;
    }
    const uploads = [...document.querySelectorAll(".q-uploader")].map((element) => getElement(element).$refs.qRef);
    const edits = EDITS.test(file.name) && uploads.find(({ $props }) => $props.accept.includes(".json"));
    const upload = edits || this.#photographs;
    const isBusy = document.querySelector(".q-dialog");
    if (isBusy || (files.length > 1 && photographs.length === 0)) {
      upload.$emit("rejected", [{ failedPropValidation: isBusy ? "dialog" : "several", file }]);
    }
    if (!isBusy) {
      upload.addFiles(photographs.length ? photographs : [file]);
    }
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
