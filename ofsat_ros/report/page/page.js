// Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"use strict";
const sky = document.getElementById("sky");
if (sky) {
  const pressed = (button, on) => button.setAttribute("aria-pressed", on);
  const show = (chosen) => {
    for (const view of sky.querySelectorAll("figure.view")) view.hidden = view.dataset.view !== chosen;
    for (const button of sky.querySelectorAll("button[data-view]")) pressed(button, button.dataset.view === chosen);
  };
  for (const button of sky.querySelectorAll("button[data-view]")) button.onclick = () => show(button.dataset.view);
  const toggle = (id, name, wanted) => {
    const button = document.getElementById(id);
    if (button) button.onclick = () => pressed(button, sky.classList.toggle(name) === wanted);
  };
  toggle("paths", "bare", false);
  toggle("large", "large", true);
  show("0");
}
// What the pointer is on, in a table or on the sky, stands out on the sky.
for (const kind of ["pointerover", "pointerout"]) {
  document.addEventListener(kind, (event) => {
    const on = event.target.closest?.("[data-track]");
    if (!on) return;
    for (const one of document.querySelectorAll(`.view [data-track="${on.dataset.track}"]`)) one.classList.toggle("hot", kind === "pointerover");
  });
}
