// Plays the replays of the gallery that are in view. Others are pictures again, because a
// browser draws only a few of them at once. Without this script a picture is a link.
document.addEventListener("DOMContentLoaded", () => {
  const root = document.documentElement;
  const address = (place) => `${place.href}#${root.dataset.theme}`;
  const watcher = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      const player = target.querySelector("iframe");
      if (!isIntersecting) player?.remove();
      if (!isIntersecting || player) continue;
      const frame = document.createElement("iframe");
      frame.src = address(target);
      frame.title = `Replay: ${target.querySelector("img").alt}`;
      target.append(frame);
    }
  }, { threshold: 0.3 });
  for (const place of document.querySelectorAll("a.replay")) watcher.observe(place);

  // The button of the site changes players, too. Only the end of their address changes,
  // so they play on.
  new MutationObserver(() => {
    for (const frame of document.querySelectorAll("a.replay iframe")) {
      frame.contentWindow.location.replace(address(frame.parentElement));
    }
  }).observe(root, { attributeFilter: ["data-theme"] });

  // The theme gives the arrows that open lists of pages no name.
  for (const arrow of document.querySelectorAll(".toctree-toggle")) {
    const page = arrow.closest("li").querySelector("a").textContent.trim();
    arrow.closest("summary").setAttribute("aria-label", `Pages below ${page}`);
  }

  // Keys scroll what is wider than the page.
  for (const formula of document.querySelectorAll(".formula")) {
    if (formula.scrollWidth > formula.clientWidth) formula.tabIndex = 0;
  }
});
