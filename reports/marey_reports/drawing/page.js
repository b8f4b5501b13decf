for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  const value = (row, column) => {
    const cell = row.cells[column];
    return cell.dataset.value === undefined ? cell.textContent : cell.dataset.value === "" ? NaN : +cell.dataset.value;
  };
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending" ||
        (!head.hasAttribute("aria-sort") && head.classList.contains("number"));
      heads.forEach((each) => each.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const compare = (a, b) => {
        const [x, y] = [value(a, column), value(b, column)];
        if (typeof x === "string") return x.localeCompare(y, undefined, { numeric: true });
        return (Number.isNaN(x) - Number.isNaN(y)) * (down ? -1 : 1) || x - y || 0;
      };
      const rows = [...table.tBodies[0].rows].sort((a, b) => (down ? -1 : 1) * compare(a, b));
      table.tBodies[0].append(...rows);
    });
  });
}
document.documentElement.classList.add("scripted");
for (const box of document.querySelectorAll("figure > div, .table")) {
  const measure = () => box.classList.toggle("scrolls", box.scrollWidth > box.clientWidth + 1);
  new ResizeObserver(measure).observe(box);
  measure();
}
const PLACE_OF_MOTION = 'id="motion">';
const packed = document.querySelector("script#player"); // the empty place of the player is a template
for (const box of packed === null ? [] : document.querySelectorAll(".player")) {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = box.dataset.label;
  box.append(button);
  box.hidden = false;
  button.addEventListener("click", async () => {
    button.disabled = true;
    const bytes = Uint8Array.from(atob(JSON.parse(packed.textContent)), (letter) => letter.charCodeAt(0));
    const inflated = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const [before, after] = (await new Response(inflated).text()).split(PLACE_OF_MOTION);
    const frame = document.createElement("iframe");
    frame.title = box.dataset.label;
    frame.setAttribute("sandbox", "allow-scripts");
    frame.srcdoc = before + PLACE_OF_MOTION + box.querySelector("script").textContent + after;
    button.replaceWith(frame);
    frame.focus();
  });
}
