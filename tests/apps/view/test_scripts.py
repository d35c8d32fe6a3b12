"""The page's JavaScript modules fit together, also where no browser is installed to open the page."""

import re
from pathlib import Path

from bhd_lerobot.apps import view

SCRIPTS = sorted((Path(view.__file__).parent / "static" / "js").glob("*.js"))
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
