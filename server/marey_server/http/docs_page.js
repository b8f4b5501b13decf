"use strict";
// Forms that send requests to this server. The token stays in its field: it is never written into an address, a cookie
// or the storage of the browser, and a reloaded page has forgotten it.
const token = document.getElementById("token");
token.value = "";

function element(tag, properties, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function fields(operation) {
  return [...operation.querySelectorAll("tr[data-name]")].map((row) => {
    const { name, place, example, required } = row.dataset;
    const value = required === undefined ? "" : example;
    const input = element("input", { value, placeholder: example, autocomplete: "off" });
    const label = element("label", {}, `${name} (${place}${required === undefined ? "" : ", needed"})`, input);
    return { name, place, input, label };
  });
}

function bodyField(operation) {
  const body = operation.querySelector("[data-body]");
  if (body === null) return null;
  const type = body.dataset.body;
  const isText = type === "application/json";
  const input = isText
    ? element("textarea", { value: body.textContent, rows: 8 })
    : element("input", { type: "file", multiple: type === "multipart/form-data" });
  return { type, input, label: element("label", {}, `Body (${type})`, input) };
}

function request(operation, parameters, body) {
  let path = operation.dataset.path;
  const query = new URLSearchParams();
  const headers = { Accept: "application/json, */*;q=0.5" };
  for (const { name, place, input } of parameters) {
    if (place === "path") path = path.replace(`{${name}}`, encodeURIComponent(input.value));
    else if (input.value !== "" && place === "query") query.set(name, input.value);
    else if (input.value !== "") headers[name] = input.value;
  }
  if (token.value.trim() !== "") headers.Authorization = `Bearer ${token.value.trim()}`;
  const options = { method: operation.dataset.method, headers, credentials: "omit", redirect: "manual" };
  if (body?.type === "application/json") {
    headers["Content-Type"] = body.type;
    options.body = body.input.value;
  } else if (body?.type === "multipart/form-data") {
    options.body = new FormData();
    for (const file of body.input.files) options.body.append("files", file);
  } else if (body !== null) {
    headers["Content-Type"] = body.type;
    options.body = body.input.files[0] ?? "";
  }
  return [path + (query.size ? `?${query}` : ""), options];
}

async function shown(answer) {
  const type = answer.headers.get("Content-Type") ?? "";
  if (type.includes("json")) return JSON.stringify(await answer.json(), null, 2);
  if (type.startsWith("text/")) return answer.text();
  return `${(await answer.blob()).size} bytes, ${type || "no content"}`;
}

function addForm(operation) {
  const parameters = fields(operation);
  const body = bodyField(operation);
  const output = element("pre", { hidden: true, tabIndex: 0 });
  const form = element("form", {}, ...parameters.map((one) => one.label), ...(body ? [body.label] : []));
  form.append(element("button", { textContent: "Send" }), output);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    output.hidden = false;
    output.textContent = "Waiting …";
    try {
      const [address, options] = request(operation, parameters, body);
      const answer = await fetch(address, options);
      output.textContent = `${answer.status} ${answer.statusText}\n\n${await shown(answer)}`;
    } catch (error) {
      output.textContent = `The request could not be sent: ${error.message}`;
    }
  });
  const box = element("details", { className: "try" }, element("summary", { textContent: "Try it" }));
  box.append(element("div", {}, form));
  operation.lastElementChild.append(box);
}

for (const operation of document.querySelectorAll("details[data-path]")) {
  operation.addEventListener("toggle", () => {
    if (operation.querySelector(".try") === null) addForm(operation);
  });
}
