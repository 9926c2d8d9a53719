"""What a page holds, by an HTML parser, and a name that no page may run."""

from html.parser import HTMLParser

HOSTILE = """</script><script>alert(1)</script><img src=x onerror=alert(2)> "'&{head}{about}"""


class Elements(HTMLParser):
    """Elements with their attributes, and the text of scripts by their id."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found, self.scripts, self._script = [], {}, None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        self._script = dict(attrs).get("id", "") if tag == "script" else None

    def handle_data(self, data):
        if self._script is not None:
            self.scripts[self._script] = self.scripts.get(self._script, "") + data

    def handle_endtag(self, tag):
        self._script = None
