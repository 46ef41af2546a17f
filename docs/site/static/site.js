// Additions to the theme of the course site.

// On a phone the strip at the top of a notebook is cut: show the marked box.
for (const strip of document.querySelectorAll('img[class*="here-"]')) {
  const box = strip.parentElement, share = strip.className.match(/here-(\d+)/)[1] / 100;
  box.scrollLeft = share * box.scrollWidth - box.clientWidth / 2;
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
