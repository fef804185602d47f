// --- what all pages do

function say(text) {
  const sentence = document.getElementById("sentence");
  sentence.textContent = text;
  sentence.hidden = !text;
}

function save(blob, name) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}
