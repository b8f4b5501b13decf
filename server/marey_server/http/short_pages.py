"""Short HTML pages for people who open an address of the server in a browser: a title, a text, no scripts."""

from __future__ import annotations

from markupsafe import Markup

BROWSER = "text/html; charset=utf-8"
STYLED = "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'; base-uri 'none'"
"""Content security policy of these pages."""
_PAGE = Markup(
    """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Marey: {title}</title>
<style>:root {{ color-scheme: light dark }}
body {{ font: 1rem/1.5 system-ui, sans-serif; margin: 4rem auto; max-width: 40rem; padding: 0 1rem }}
code {{ display: block; background: #eee; color: #000; padding: .5rem; overflow-wrap: anywhere }}</style></head>
<body><main><h1>{title}</h1><p>{text}</p>{code}</main></body></html>
"""
)


def page(title: str, text: str, code: str = "") -> bytes:
    """Return an HTML page with a title and a text, and with `code`, which the person copies, if it is given."""
    shown = Markup("<p><code>{}</code></p>").format(code) if code else ""
    return _PAGE.format(title=title, text=text, code=shown).encode()
