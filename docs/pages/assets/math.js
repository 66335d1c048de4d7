// Sets the formulas of a page: those of Markdown stand in elements of class arithmatex, those of notebooks between dollar signs.
(() => {
  const tex = [
    { left: "\\[", right: "\\]", display: true },
    { left: "\\(", right: "\\)", display: false },
  ];
  const dollars = [
    { left: "$$", right: "$$", display: true },
    { left: "$", right: "$", display: false },
  ];
  const set = (selector, delimiters) => {
    for (const element of document.querySelectorAll(selector)) {
      renderMathInElement(element, { delimiters, throwOnError: false, strict: "ignore", ignoredClasses: ["katex"] });
    }
  };
  set(".arithmatex, .md-nav__link", tex);
  set(".jp-RenderedMarkdown, .jp-RenderedLatex, .md-nav__link", dollars);
})();
