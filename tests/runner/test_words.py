"""The check of the glossary that `make lint` runs."""

import subprocess
import sys
from pathlib import Path

WORDS = Path(__file__).parents[2] / "tools" / "words.py"


def check(root: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(WORDS), str(root)], capture_output=True, text=True, timeout=60, check=False)


def test_private_words_are_found_in_documents_and_documentation_comments_alone(tmp_path: Path) -> None:
    (tmp_path / "lib.rs").write_text("/// Maps ticks to host time, by `picture()`.\n// A picture.\nfn picture() {}\n")
    (tmp_path / "a.md").write_text("An image.\n```\npicture\n```\n")
    assert check(tmp_path).returncode == 0, check(tmp_path).stdout
    for name, text, word in [
        ("lib.rs", "/// The picture.\n", "picture"),
        ("lib.rs", "/// What a camera sends.\n", "What"),
        ("a.md", "The left eye.\n", "eye"),
        ("rig.toml", "rate_hz = 5  # told by the camera\n", "told"),
        ("rig.toml", "# -1 is none\n", "is none"),
    ]:
        (tmp_path / name).write_text(text)
        found = check(tmp_path)
        assert found.returncode == 1 and word in found.stdout and f"{name}:1" in found.stdout, found.stdout
        (tmp_path / name).unlink()
