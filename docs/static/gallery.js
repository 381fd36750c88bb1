// Plays the replays of the gallery that are in view. Others are pictures again, because a
// browser draws only a few of them at once. Without this script a picture is a link.
document.addEventListener("DOMContentLoaded", () => {
  const watcher = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      const player = target.querySelector("iframe");
      if (!isIntersecting) player?.remove();
      if (!isIntersecting || player) continue;
      const frame = document.createElement("iframe");
      frame.src = target.href;
      frame.title = `Replay: ${target.querySelector("img").alt}`;
      target.append(frame);
    }
  }, { threshold: 0.3 });
  for (const place of document.querySelectorAll("a.replay")) watcher.observe(place);
});
