// SPDX-License-Identifier: Apache-2.0
// Browsers start no worker in a page that was opened as a file; the search then runs in a hidden frame.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      const loaded = new Promise((resolve) => {
        frame.onload = () => {
          const inner = frame.contentWindow;
          const load = (address) =>
            new Promise((done, failed) => {
              const script = inner.document.createElement("script");
              Object.assign(script, { src: address, onload: done, onerror: failed });
              inner.document.body.append(script);
            });
          inner.importScripts = async (...addresses) => {
            for (const address of addresses) await load(address);
          };
          inner.postMessage = (data) => {
            const event = new MessageEvent("message", { data });
            this.dispatchEvent(event);
            this.onmessage?.(event);
          };
          load(url).then(() => resolve(inner));
        };
      });
      frame.srcdoc = "<!doctype html><body></body>";
      document.body.append(frame);
      this.postMessage = (data) =>
        loaded.then((inner) => inner.dispatchEvent(new inner.MessageEvent("message", { data })));
      this.terminate = () => frame.remove();
    }
  };
}
