"""The page's JavaScript modules and styles fit together, also where no browser is installed to open the page."""

import re
from pathlib import Path

from bhd_lerobot.apps import view

STATIC = Path(view.__file__).parent / "static"
SCRIPTS = sorted((STATIC / "js").glob("*.js"))
DECLARED = re.compile(r"^(export )?(?:async )?(?:function\*?|const|let|class) (?:(\w+)|\{([^}]*)\})", re.MULTILINE)
IMPORTED = re.compile(r"^import \{([^}]*)\} from \"\./([\w.]+)\"", re.MULTILINE)


def names(listed: str) -> list[str]:
    return [name.strip() for name in listed.split(",") if name.strip()]


def test_every_import_is_exported_and_no_name_is_declared_twice() -> None:
    text = {path.name: path.read_text(encoding="utf-8") for path in SCRIPTS}
    assert "app.js" in text
    exported = {name: {found[2] for found in DECLARED.finditer(script) if found[1]} for name, script in text.items()}
    for name, script in text.items():
        declared = [one for found in DECLARED.finditer(script) for one in (names(found[3]) if found[3] else [found[2]])]
        for listed, source in IMPORTED.findall(script):
            assert set(names(listed)) <= exported[source], (name, source)
            declared += names(listed)
        assert sorted(declared) == sorted(set(declared)), name


def test_a_phone_keeps_the_transport_controls_in_the_window() -> None:
    phone = (STATIC / "style.css").read_text(encoding="utf-8").partition("@media (max-width: 760px)")[2]
    timeline = re.findall(r"#timeline \{([^}]*)\}", phone)
    assert len(timeline) == 1
    assert {"position: sticky", "bottom: 0"} <= {rule.strip() for rule in timeline[0].split(";")}
    sheets = re.findall(r'rel="stylesheet" href="([^"]*)"', (STATIC / "index.html").read_text(encoding="utf-8"))
    assert sheets[-1] == "/static/style.css"  # else those of the timeline undo it
