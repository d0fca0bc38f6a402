// What keeps people out of a page, as far as a script can see it. Evaluates to a list of sentences.
() => {
  // A button that was released a moment ago is between two colours.
  for (const each of document.getAnimations()) if (each instanceof CSSTransition) each.finish();
  const flaws = [];
  const all = (selector) => [...document.querySelectorAll(selector)];
  const seen = (element) => element.checkVisibility({ visibilityProperty: true });
  const words = (element) => element.textContent.trim().replace(/\s+/g, " ");
  const show = (element) => element.outerHTML.slice(0, 100);
  const named = (element) =>
    element.getAttribute("aria-label") ||
    (element.getAttribute("aria-labelledby") ?? "").split(" ").map((id) => document.getElementById(id)?.textContent ?? "").join("") ||
    [...(element.labels ?? [])].map(words).join("");

  if (!document.documentElement.lang) flaws.push("the page has no language");
  if (!document.title.trim()) flaws.push("the page has no title");
  if (all("main").length !== 1) flaws.push("there must be one main");
  if (all("h1").filter(seen).length > 1) flaws.push("more than one h1");
  const headings = all("h1, h2, h3, h4, h5, h6").filter(seen).map((each) => Number(each.tagName[1]));
  headings.forEach((level, at) => at && level > headings[at - 1] + 1 && flaws.push(`h${level} follows h${headings[at - 1]}`));

  const ids = all("[id]").map((each) => each.id);
  for (const id of new Set(ids.filter((id, at) => ids.indexOf(id) !== at))) flaws.push(`two elements have the id ${id}`);
  for (const attribute of ["for", "aria-labelledby", "aria-describedby"])
    for (const each of all(`[${attribute}]`))
      for (const id of each.getAttribute(attribute).split(" "))
        if (!document.getElementById(id)) flaws.push(`nothing has the id ${id}: ${show(each)}`);

  for (const each of all("input:not([type=hidden]), select, textarea").filter(seen))
    if (!named(each)) flaws.push(`no label: ${show(each)}`);
  for (const each of all("button, a").filter(seen))
    if (!words(each) && !named(each)) flaws.push(`no name: ${show(each)}`);
  for (const each of all("input[type=radio]").filter(seen))
    if (!each.closest("fieldset")?.querySelector("legend") && !each.closest("tr")?.querySelector("th[scope=row]"))
      flaws.push(`a choice without its question: ${show(each)}`);
  for (const each of all("img, canvas, svg").filter(seen))
    if (!named(each) && each.getAttribute("alt") === null && !each.closest("[aria-hidden=true]")) flaws.push(`a picture without words: ${show(each)}`);
  for (const each of all("[role=status], [role=alert]"))
    if (each.closest("[aria-hidden=true]")) flaws.push(`a status nobody hears: ${show(each)}`);
  for (const each of all("[tabindex]")) if (each.tabIndex > 0) flaws.push(`a tabindex above 0: ${show(each)}`);

  // Targets: 24 by 24 pixels at least, or inside of a label that is.
  for (const each of all("button, input:not([type=hidden]), select, textarea, a").filter(seen)) {
    const target = each.closest("label") ?? each;
    const box = target.getBoundingClientRect();
    if (!each.closest("p, li") && (box.width < 24 || box.height < 24)) flaws.push(`too small to hit, ${box.width} x ${box.height}: ${show(each)}`);
  }

  // Contrast: 4.5 to 1, or 3 to 1 for large letters.
  const parse = (colour) => (colour.match(/[\d.]+/g) ?? []).map(Number);
  const light = ([r, g, b]) => [r, g, b].map((c) => (c /= 255) <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4)
    .reduce((sum, c, at) => sum + c * [0.2126, 0.7152, 0.0722][at], 0);
  const behind = (element) => {
    for (let each = element; each; each = each.parentElement) {
      const [r, g, b, a = 1] = parse(getComputedStyle(each).backgroundColor);
      if (a === 1) return [r, g, b];
      if (a > 0) return null; // mixed: not ours to judge
    }
    return [255, 255, 255];
  };
  const texts = new Set();
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) if (walker.currentNode.data.trim()) texts.add(walker.currentNode.parentElement);
  for (const each of texts) {
    if (!seen(each) || each.closest("script, style, noscript, option, [inert], [disabled]")) continue;
    const style = getComputedStyle(each);
    const back = behind(each);
    if (!back || each.getBoundingClientRect().width <= 1) continue;
    const [a, b] = [light(parse(style.color)), light(back)].sort((x, y) => y - x);
    const large = parseFloat(style.fontSize) >= 24 || (parseFloat(style.fontSize) >= 18.6 && Number(style.fontWeight) >= 700);
    const contrast = (a + 0.05) / (b + 0.05);
    if (contrast < (large ? 3 : 4.5)) flaws.push(`contrast ${contrast.toFixed(1)}: ${show(each)}`);
  }
  return flaws;
}
