// A viewer in a notebook: the page in a frame, and its questions over the kernel's own channel

const STATE = ["light", "degrees", "axis", "tip", "exposure", "camera", "lamps"];

export default {
  async render({ model, el }) {
    const frame = Object.assign(document.createElement("iframe"), { srcdoc: model.get("page") });
    Object.assign(frame.style, { width: "100%", height: `${model.get("height")}px`, border: "0" });
    const loaded = new Promise((done) => frame.addEventListener("load", done, { once: true }));
    el.replaceChildren(frame);
    await loaded;
    const viewer = await frame.contentWindow.viewer;
    if (!viewer) return undefined; // the page says why
    const waiting = new Map();
    let number = 0;
    const received = async (message, buffers) => {
      if (message.number !== undefined) {
        const [view] = buffers, bytes = view.buffer ? view.buffer.slice(view.byteOffset, view.byteOffset + view.byteLength) : view;
        const done = waiting.get(message.number);
        waiting.delete(message.number);
        if (done) done([message.header, bytes]);
      } else if (message.screenshot !== undefined) {
        const blob = await viewer.screenshot();
        model.send({ screenshot: message.screenshot }, undefined, [await blob.arrayBuffer()]);
      }
    };
    model.on("msg:custom", received);
    viewer.connect((header, content = new Uint8Array()) => new Promise((done) => {
      waiting.set(++number, done);
      const bytes = content.buffer.slice(content.byteOffset, content.byteOffset + content.byteLength);
      model.send({ number, header }, undefined, [bytes]);
    }));
    const show = () => viewer.apply(Object.fromEntries(STATE.map((name) => [name, model.get(name)])));
    const changes = STATE.map((name) => `change:${name}`).join(" ");
    show();
    model.on(changes, show);
    viewer.onstill = () => {
      const now = viewer.shown;
      if (STATE.every((name) => String(now[name]) === String(model.get(name)))) return;
      for (const name of STATE) model.set(name, now[name]);
      model.save_changes();
    };
    return () => {
      viewer.onstill = null;
      model.off(changes, show);
      model.off("msg:custom", received);
    };
  },
};
