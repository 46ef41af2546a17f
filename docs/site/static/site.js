// Additions to the theme of the course site.

// On a phone the strip at the top of a notebook, 940 pixels wide, is cut: scroll to the marked box. The class here-N,
// which course.py sets, has the left end of the box in pixels; a quarter of what is in view stays before it.
for (const strip of document.querySelectorAll('img[class*="here-"]')) {
  const box = strip.parentElement;
  box.scrollLeft = strip.className.match(/here-(\d+)/)[1] / 940 * box.scrollWidth - box.clientWidth / 4;
}

// A table with a row of many columns and characters uses the margin at the right.
for (const table of document.querySelectorAll("table:has(td:nth-child(7))")) {
  const box = table.closest(".cell_output") ?? table.parentElement, isWide = (row) => row.innerText.length > 80;
  if ([...table.rows].some(isWide)) box.classList.add("full-width");
}

// A link to something folded unfolds it, also where the browser does not.
function unfold() {
  const target = document.getElementById(decodeURIComponent(location.hash.slice(1))), fold = target?.closest("details");
  if (fold && !fold.open) {
    fold.open = true;
    target.scrollIntoView();
  }
}
addEventListener("hashchange", unfold);
unfold();
