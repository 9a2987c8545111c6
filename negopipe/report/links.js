// Links within the page where the browser follows none: in the frame in which MLflow shows an artifact, whose address is
// of another origin than the page in it.
"use strict";
document.querySelector("nav").addEventListener("click", ({target}) => {
  const name = target.getAttribute("href")?.slice(1);
  if (name) document.getElementById(name).scrollIntoView();
});
