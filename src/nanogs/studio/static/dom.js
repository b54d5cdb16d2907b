// DOM helpers that all modules use.

export const byId = (id) => document.getElementById(id);

export function make(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

export function drawn(name, attributes = {}, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

// Makes a group of buttons of which one is pressed. `choices` is a list of [value, words, title].
export function segments(host, choices, choose) {
  const buttons = choices.map(([value, words, title = ""]) => {
    const button = make("button", { type: "button", textContent: words, title });
    button.dataset.value = value;
    button.addEventListener("click", () => choose(value));
    return button;
  });
  host.replaceChildren(...buttons);
  return (value) => {
    for (const button of buttons)
      button.setAttribute("aria-pressed", String(button.dataset.value === value));
  };
}

// Calls `commit` when a field has changed or Enter is pressed, which does not submit the form.
export function onCommit(field, commit) {
  field.addEventListener("change", commit);
  field.addEventListener("keydown", (event) => {
    if (event.key !== "Enter") return;
    event.preventDefault();
    commit();
  });
}

// Shows a command of which no line ends after the dashes of an option; it is copied as it is.
export function showCommand(host, command) {
  const words = (command ?? "").split(/(\s)(--?[a-z][a-z0-9-]*)(?=\s|$)/);
  host.replaceChildren(
    ...words.map((text, place) =>
      place % 3 === 2 ? make("span", { className: "option", textContent: text }) : text,
    ),
  );
}

export function copyButton(button, words) {
  button.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(words().textContent);
      button.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(words());
      button.textContent = "Press Ctrl-C";
    }
    setTimeout(() => (button.textContent = "Copy"), 2000);
  });
}
