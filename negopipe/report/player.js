// Films with a scrubber. A film is a GIF on the page: without scripts it plays as such. The script unpacks it, draws its
// frames on a canvas and adds the controls: play and pause, a frame back and forth, a slider, the speed. A film plays
// once when it comes into view; for readers who prefer no motion it waits. It reads what negopipe/report/animation.py
// writes: GIFs that are not interlaced, whose frames stay until they are drawn over.
"use strict";
(() => {
  const SPEEDS = [1, 2, 0.5];
  const ICONS = {
    play: "M4 2v12l9-6z", pause: "M4 2h3v12H4zM9 2h3v12H9z", back: "M3 2h2v12H3zM13 2v12L6 8z",
    forth: "M11 2h2v12h-2zM3 2v12l7-6z",
  };

  // Pixels, as indices into the palette, of a frame's LZW code.
  function unpack(codeBits, data, nPixels) {
    const prefix = new Uint16Array(4096), suffix = new Uint8Array(4096), stack = new Uint8Array(4097);
    const pixels = new Uint8Array(nPixels), clear = 1 << codeBits;
    let width = codeBits + 1, next = clear + 2, before = -1, first = 0, held = 0, nHeld = 0, top = 0, n = 0;
    for (const byte of data) {
      held |= byte << nHeld;
      nHeld += 8;
      while (nHeld >= width) {
        const read = held & ((1 << width) - 1);
        held >>= width;
        nHeld -= width;
        if (read === clear + 1) return pixels;
        if (read === clear) {
          width = codeBits + 1;
          next = clear + 2;
          before = -1;
          continue;
        }
        let code = read;
        if (read >= next) {  // the entry that this very code completes
          stack[top++] = first;
          code = before;
        }
        for (; code > clear; code = prefix[code]) stack[top++] = suffix[code];
        stack[top++] = first = code;
        if (before >= 0 && next < 4096) {
          prefix[next] = before;
          suffix[next++] = first;
          if (next === 1 << width && width < 12) width++;
        }
        before = read;
        while (top) pixels[n++] = stack[--top];
      }
    }
    return pixels;
  }

  // Size and frames of a GIF.
  function read(gif) {
    let at = 13, transparent = -1, delayMs = 0;
    const word = place => gif[place] | gif[place + 1] << 8;
    const palette = flags => {
      const colors = new Uint32Array(flags & 0x80 ? 2 << (flags & 7) : 0);
      for (let i = 0; i < colors.length; i++, at += 3) {
        colors[i] = 0xff000000 | gif[at + 2] << 16 | gif[at + 1] << 8 | gif[at];
      }
      return colors;
    };
    const blocks = () => {
      const parts = [];
      for (; gif[at]; at += gif[at] + 1) parts.push(...gif.subarray(at + 1, at + 1 + gif[at]));
      at++;
      return parts;
    };
    const shared = palette(gif[10]), frames = [];
    while (gif[at] !== 0x3b) {
      if (gif[at] === 0x21) {  // an extension; 0xf9 holds the duration and the transparent colour of the next frame
        if (gif[at + 1] === 0xf9) {
          transparent = gif[at + 3] & 1 ? gif[at + 6] : -1;
          delayMs = 10 * word(at + 4);
        }
        at += 2;
        blocks();
        continue;
      }
      const [x, y, width, height] = [1, 3, 5, 7].map(field => word(at + field)), flags = gif[at + 9];
      at += 10;
      const own = palette(flags), codeBits = gif[at++];
      const pixels = unpack(codeBits, blocks(), width * height);
      frames.push({x, y, width, height, pixels, transparent, delayMs, palette: own.length ? own : shared});
    }
    return {width: word(6), height: word(8), frames};
  }

  function addButton(parent, label, icon) {
    const made = parent.appendChild(document.createElement("button"));
    made.type = "button";
    made.setIcon = (words, name) => {
      made.title = words;
      made.setAttribute("aria-label", words);
      made.innerHTML = `<svg viewBox="0 0 16 16" aria-hidden="true"><path d="${ICONS[name]}"/></svg>`;
    };
    if (icon) made.setIcon(label, icon);
    return made;
  }

  class Film {
    // fastest: seconds that the first showing takes at most, if twice the speed is enough for that
    constructor(gif, label, fastest) {
      Object.assign(this, gif);
      this.canvas = document.createElement("canvas");
      Object.assign(this.canvas, {width: this.width, height: this.height});
      this.canvas.setAttribute("role", "img");
      this.canvas.setAttribute("aria-label", label);
      this.context = this.canvas.getContext("2d");
      this.image = this.context.createImageData(this.width, this.height);
      this.colors = new Uint32Array(this.image.data.buffer);
      this.last = this.frames.length - 1;
      this.drawn = -1;
      this.timer = null;
      this.isFresh = true;  // neither shown to its end nor touched
      const lasts = this.frames.slice(0, -1).reduce((sum, frame) => sum + frame.delayMs, 0);
      this.speed = lasts > 1000 * fastest ? 2 : 1;
      this.controls = document.createElement("div");
      this.controls.className = "controls";
      this.addControls(this.controls);
      this.pause();
      this.show(0);
    }

    addControls(bar) {
      this.toggle = addButton(bar);
      const back = addButton(bar, "One frame back", "back");
      this.slider = bar.appendChild(document.createElement("input"));
      Object.assign(this.slider, {type: "range", min: 0, max: this.last, step: 1});
      this.slider.setAttribute("aria-label", "Frame");
      const forth = addButton(bar, "One frame forward", "forth"), speed = addButton(bar);
      speed.title = "Speed";
      const tell = () => { speed.textContent = `${this.speed === 0.5 ? "½" : this.speed}×`; };
      tell();
      speed.onclick = () => {
        this.speed = SPEEDS[(SPEEDS.indexOf(this.speed) + 1) % SPEEDS.length];
        tell();
      };
      const stopAt = frame => {
        this.pause();
        this.isFresh = false;
        this.show(Math.min(Math.max(frame, 0), this.last));
      };
      back.onclick = () => stopAt(this.drawn - 1);
      forth.onclick = () => stopAt(this.drawn + 1);
      this.slider.oninput = () => stopAt(Number(this.slider.value));
      this.toggle.onclick = this.canvas.onclick = () => {
        this.isFresh = false;
        if (this.timer === null) this.play();
        else this.pause();
      };
    }

    // Draw the frame of an index: all that are not drawn yet, one over the other.
    show(index) {
      if (index < this.drawn) this.drawn = -1;
      while (this.drawn < index) this.add(this.frames[++this.drawn]);
      this.context.putImageData(this.image, 0, 0);
      this.slider.value = index;
    }

    add({x, y, width, height, pixels, transparent, palette}) {
      for (let row = 0, i = 0; row < height; row++) {
        for (let at = (y + row) * this.width + x, end = at + width; at < end; at++, i++) {
          if (pixels[i] !== transparent) this.colors[at] = palette[pixels[i]];
        }
      }
    }

    play() {
      if (this.drawn === this.last) this.show(0);
      this.toggle.setIcon("Pause", "pause");
      const next = () => {
        this.show(this.drawn + 1);
        if (this.drawn < this.last) wait();
        else this.pause();
      };
      const wait = () => { this.timer = setTimeout(next, this.frames[this.drawn].delayMs / this.speed); };
      clearTimeout(this.timer);
      wait();
    }

    pause() {
      clearTimeout(this.timer);
      this.timer = null;
      this.isFresh &&= this.drawn < this.last;
      this.toggle.setIcon("Play", "play");
    }
  }

  // The film in the place of the GIF; undefined where the GIF is a single picture.
  function filmOf(picture) {
    const img = picture.querySelector("img"), data = atob(img.src.slice(img.src.indexOf(",") + 1));
    const gif = read(Uint8Array.from(data, letter => letter.charCodeAt(0)));
    if (gif.frames.length < 2) return undefined;
    const film = new Film(gif, img.alt, Number(picture.dataset.fastest ?? Infinity));
    picture.replaceWith(film.canvas, film.controls);
    return film;
  }

  const isStill = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const films = new Map();
  const comeOrGo = ({target, isIntersecting}) => {
    if (isIntersecting && !films.has(target)) {
      films.set(target, filmOf(target.querySelector("picture")));
      if (isStill) films.get(target)?.show(Math.floor(films.get(target).last / 3));
    }
    const film = films.get(target);
    if (isStill || !film?.isFresh) return;
    if (isIntersecting) film.play();
    else film.pause();
  };
  const observer = new IntersectionObserver(entries => entries.forEach(comeOrGo), {threshold: 0.5});
  document.querySelectorAll(".film").forEach(figure => observer.observe(figure));
})();
