/* Uses the page as a person would and tells what happened in data-poke-* attributes of the document. */
(async () => {
  const tell = (key, value) => document.documentElement.setAttribute("data-poke-" + key, value);
  const rest = () => new Promise(done => setTimeout(done, 30));
  const over = document.querySelector("#chart-winding .u-over"), box = over.getBoundingClientRect();
  const mouse = (type, x, target = over) => target.dispatchEvent(new MouseEvent(type, {
    clientX: box.left + x, clientY: box.top + 50, bubbles: true, button: 0, view: window, movementX: 5 }));
  const shown = () => document.getElementById("window").textContent;

  tell("whole", shown());
  mouse("mouseenter", 300); mouse("mousemove", 300); await rest();
  const open = [...document.querySelectorAll(".readout")].filter(r => !r.hidden);
  tell("readouts", open.length);
  tell("first", open[0].textContent);

  mouse("mousedown", 300); mouse("mousemove", 500); await rest(); mouse("mouseup", 500, document); await rest();
  tell("zoomed", shown());
  over.dispatchEvent(new MouseEvent("dblclick", { bubbles: true, view: window })); await rest();
  tell("reset", shown());

  const entry = document.querySelector("#chart-winding .legend button");
  entry.click(); await rest();
  tell("legend", entry.getAttribute("aria-pressed"));
  document.getElementById("theme").click(); await rest();
  tell("theme", document.documentElement.dataset.theme);
  const loaded = performance.getEntriesByType("resource").map(r => r.name).filter(name => !name.startsWith("data:"));
  tell("loaded", loaded.join(" "));
  tell("done", true);
})();
