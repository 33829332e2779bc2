// A photo that is dropped anywhere on the page, or chosen, is sent at once.
const form = document.querySelector("form");
const input = form.querySelector("input[type=file]");
const send = () => {
  document.body.classList.add("busy");
  form.submit();
};
input.addEventListener("change", () => input.files.length && send());
for (const name of ["dragenter", "dragover"]) {
  document.addEventListener(name, (event) => {
    event.preventDefault();
    document.body.classList.add("over");
  });
}
document.addEventListener("dragleave", (event) => {
  if (!event.relatedTarget) document.body.classList.remove("over");
});
document.addEventListener("drop", (event) => {
  event.preventDefault();
  document.body.classList.remove("over");
  if (event.dataTransfer.files.length) {
    const one = new DataTransfer();
    one.items.add(event.dataTransfer.files[0]);
    input.files = one.files;
    send();
  }
});
window.addEventListener("pageshow", () => document.body.classList.remove("busy"));
document.body.classList.add("scripted");
