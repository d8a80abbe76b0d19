// A page that was opened from a folder may start no worker, and the site's search is one. There it runs in a frame of the page instead, with the
// same messages. Elsewhere this does nothing.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    #frame = document.createElement("iframe");
    #ready;

    constructor(url) {
      super();
      const frame = this.#frame;
      frame.hidden = true;
      frame.srcdoc = "<!doctype html>"; // of the page's own origin
      this.#ready = new Promise((done, failed) => {
        frame.onload = () => {
          const script = frame.contentDocument.createElement("script");
          frame.contentWindow.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
          script.onload = () => done(frame.contentWindow);
          script.onerror = () => failed(new Error(`${url} can't be loaded`));
          script.src = new URL(url, document.baseURI);
          frame.contentDocument.head.append(script);
        };
      });
      document.body.append(frame);
    }

    postMessage(data) {
      this.#ready.then((inside) => inside.dispatchEvent(new inside.MessageEvent("message", { data })));
    }

    terminate() {
      this.#frame.remove();
    }
  };
}
