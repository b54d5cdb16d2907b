// The line between two still pictures. The pictures are those of the list below it.
{
  const part = (id) => document.getElementById(id);
  const [stage, line, model, difference] = ["stage", "line", "model", "difference"].map(part);
  const [under, over] = stage.querySelectorAll("img");
  const count = Number(stage.dataset.views);
  let view = 0;

  function show() {
    const chosen = model ? model.value : "0";
    const result = part(`${difference.checked ? "error" : "result"}-${view}-${chosen}`);
    under.src = part(`original-${view}`).src;
    over.src = result.src;
    under.alt = part(`original-${view}`).alt;
    over.alt = result.alt;
    part("right").textContent = difference.checked ? "difference" : result.dataset.name;
    part("place").textContent = `View ${view + 1} of ${count}`;
    part("caption").textContent = part(`result-${view}-${chosen}`).dataset.caption;
    divide();
  }

  function divide() {
    stage.style.setProperty("--cut", `${line.value}%`);
    line.setAttribute("aria-valuetext", `${Math.round(line.value)} % ${part("left").textContent}`);
  }

  const step = (by) => () => {
    view = (view + by + count) % count;
    show();
  };
  // Views may differ in shape, and each is to fit into the window.
  under.addEventListener("load", () => {
    stage.style.setProperty("--shape", under.naturalWidth / under.naturalHeight);
  });
  part("before").addEventListener("click", step(-1));
  part("after").addEventListener("click", step(1));
  line.addEventListener("input", divide);
  difference.addEventListener("change", show);
  model?.addEventListener("change", show);
  show();
}
