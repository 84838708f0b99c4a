"use strict";
// Replaces the SVG of each chart with Vega's drawing once it comes into view. If anything fails,
// the SVG stays. Names in the page's rows are only ever inserted as text.
addEventListener("beforeprint", () => {  // on paper, nothing can be unfolded
  document.querySelectorAll("details.rows").forEach((folded) => { folded.open = true; });
});
(() => {
  if (!("DecompressionStream" in window && "IntersectionObserver" in window)) return;
  const { config, rows, charts } = JSON.parse(document.getElementById("charts").textContent);

  let unpacked = null;
  async function unpack() {
    const packed = atob(document.getElementById("runtime").textContent);
    const bytes = Uint8Array.from(packed, (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
    return window.vegaEmbed;
  }

  async function show(drawing) {
    const vegaEmbed = await (unpacked ??= unpack());
    const { rows: names, spec } = charts[drawing.dataset.chart];
    // Vega adds marks to the rows that it reads, so each chart gets a copy.
    const datasets = structuredClone(Object.fromEntries(names.map((name) => [name, rows[name]])));
    const place = document.createElement("div");
    place.className = "live";
    drawing.append(place);
    try {
      await vegaEmbed(place, { ...spec, datasets }, {
        mode: "vega-lite", renderer: "svg", config, ast: true, actions: false,
        defaultStyle: false, tooltip: { disableDefaultStyle: true },
      });
      drawing.classList.add("shown");
      document.getElementById("pointer").hidden = false;
    } catch (error) {
      place.remove();
      console.error(error);
    }
  }

  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      seen.unobserve(entry.target);
      show(entry.target);
    }
  }, { rootMargin: "300px" });
  document.querySelectorAll(".drawing[data-chart]").forEach((drawing) => seen.observe(drawing));
})();
