// A number that changes with time, with its curve over the whole replay.
class Readout {
  constructor({ name, values }, { times, duration }) {
    this.values = values;
    const title = $("readouts").appendChild(document.createElement("dt"));
    title.textContent = breakable(name);
    title.title = name;
    this.number = $("readouts").appendChild(document.createElement("dd"));
    const chart = $("readouts").appendChild(document.createElement("dd"));
    chart.className = "chart";
    const finite = values.filter(Number.isFinite);
    let [low, high] = [Infinity, -Infinity];
    for (const value of finite) {
      low = Math.min(low, value);
      high = Math.max(high, value);
    }
    const rise = high > low ? high - low : 1;
    let pen = "M";
    let path = "";
    values.forEach((value, k) => {
      if (!Number.isFinite(value)) {
        pen = "M";
        return;
      }
      const x = (100 * times[k]) / (duration || 1);
      path += `${pen}${x.toFixed(2)} ${(24 - (22 * (value - low)) / rise).toFixed(2)}`;
      pen = "L";
    });
    chart.innerHTML =
      '<svg viewBox="0 0 100 26" preserveAspectRatio="none" aria-hidden="true">' +
      `<path class="curve" d="${path}"/><line class="now" y1="0" y2="26"/></svg>`;
    this.cursor = chart.querySelector(".now");
  }

  show(time, recording) {
    const value = this.values[recording.frameAt(time)];
    const size = Math.abs(value);
    const plain = size >= 0.01 && size < 1e5;
    const text = !Number.isFinite(value) ? "–"
      : value === 0 ? "0"
      : plain ? value.toFixed(size < 10 ? 3 : size < 1000 ? 2 : 0)
      : value.toExponential(2);
    this.number.textContent = text.replace("-", "−");
    const x = (100 * time) / (recording.duration || 1);
    this.cursor.setAttribute("x1", x);
    this.cursor.setAttribute("x2", x);
  }
}
