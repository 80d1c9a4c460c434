"use strict";
// Sorting by a column: cells say in data-v what they are sorted by.
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => {
    const head = button.closest("th");
    const table = head.closest("table");
    const column = [...head.parentNode.children].indexOf(head);
    const was = head.getAttribute("aria-sort");
    const first = head.dataset.first || "ascending";
    const other = first === "ascending" ? "descending" : "ascending";
    const now = was === first ? other : first;
    for (const th of table.tHead.rows[0].cells) th.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", now);
    const sign = now === "ascending" ? 1 : -1;
    const key = (row) => row.cells[column].dataset.v ?? row.cells[column].textContent.trim();
    const rows = [...table.tBodies[0].rows].map((row, index) => ({ row, index, key: key(row) }));
    rows.sort((a, b) => {
      // What has no value comes last, whichever way it is sorted.
      if (a.key === "" || b.key === "") return (a.key === "") - (b.key === "") || a.index - b.index;
      const x = Number(a.key), y = Number(b.key);
      const by = Number.isNaN(x) || Number.isNaN(y)
        ? a.key.localeCompare(b.key, undefined, { numeric: true }) : x - y;
      return sign * by || a.index - b.index;
    });
    table.tBodies[0].append(...rows.map((r) => r.row));
  });
}
const toggle = document.getElementById("theme");
toggle.addEventListener("click", () => {
  const root = document.documentElement;
  const dark = root.dataset.theme
    ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
});
