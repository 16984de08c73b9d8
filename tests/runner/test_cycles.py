"""The check for import cycles that `make lint` runs."""

import subprocess
import sys
from pathlib import Path

CYCLES = Path(__file__).parents[2] / "tools" / "cycles.py"


def check(root: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(CYCLES), str(root)], capture_output=True, text=True, timeout=60, check=False)


def test_two_files_that_import_each_other_are_found(tmp_path: Path) -> None:
    src = tmp_path / "crate" / "src"
    src.mkdir(parents=True)
    (tmp_path / "crate" / "Cargo.toml").write_text("[package]\n")
    (src / "lib.rs").write_text("mod a;\nmod b;\npub use a::A;\n")
    (src / "a.rs").write_text("pub struct A;\nuse crate::b::B;\n")
    (src / "b.rs").write_text("pub struct B;\n#[cfg(test)]\nmod tests {\n    use crate::A;\n}\n")
    assert check(tmp_path).returncode == 0, "a test may import anything"
    (src / "b.rs").write_text("pub struct B;\nuse crate::A;\n")
    found = check(tmp_path)
    assert found.returncode == 1 and "a.rs" in found.stdout and "b.rs" in found.stdout, found.stdout
