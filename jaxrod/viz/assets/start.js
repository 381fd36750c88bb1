// Starts the player on the recording of the page.

async function main() {
  try {
    const header = JSON.parse($("header").textContent);
    const recording = await unpackRecording(header, $("data").textContent);
    const player = new Player(recording);
    if (header.autoplay && !player.camera.still) player.play();
  } catch (error) {
    $("message").textContent = error.message;
    $("message").hidden = false;
    throw error;
  }
}

main();
