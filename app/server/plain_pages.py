"""Pages without scripts: signing in, and addresses that do not exist."""

from html import escape

_PAGE = (
    '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Beliefscope</title>'
    '<meta name="viewport" content="width=device-width, initial-scale=1">'
    '<meta name="color-scheme" content="light dark">'
    "<style>body{{font:15px/1.5 system-ui,sans-serif;max-width:34rem;margin:18vh auto 0;padding:0 1.5rem}}"
    "input,button{{font:inherit;padding:.3rem .6rem}}</style>{head}</head>"
    "<body><h1>Beliefscope</h1>{body}</body></html>"
)


POLICY = {
    "content-security-policy": "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'; "
    "base-uri 'none'; form-action 'none'"
}
"""Header of a page without forms."""


def plain_page(body: str, head: str = "") -> str:
    """A small HTML page."""
    return _PAGE.format(head=head, body=body)


def not_found_page(path: str) -> str:
    """The page for an address that does not exist."""
    return plain_page(
        f'<p>This server has no page <code>{escape(path)}</code>.</p><p><a href="/">Open the dashboard</a></p>'
    )
