"""Pages: links lead somewhere, commands name what exists, and the lines of data.md read a data set."""

import re
import shlex
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import skin
from skin.__main__ import verbs
from skin.core.files import CONF, ROOT
from skin.device.files import DataSet, read_recording
from skin.runs.build import build_device
from skin.runs.configuration import settings_of, validate_config
from skin.runs.generation import generate_data_set

DOCS = ROOT / "docs"
PAGES = sorted(path for folder in (DOCS, DOCS / "adr", ROOT) for path in folder.glob("*.md"))
FENCED = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)


def slugs(path: Path) -> set[str]:
    """Return the anchors of a page: its headings as GitHub names them, and those written as HTML."""
    text = path.read_text()
    headings = re.findall(r"^#+ (.+)$", FENCED.sub("", text), re.MULTILINE)
    named = {re.sub(r"[^\w\- ]", "", one.lower()).replace(" ", "-") for one in headings}
    return named | set(re.findall(r'<a (?:name|id)="([^"]+)"', text))


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", FENCED.sub("", page.read_text())):
        if not re.match(r"[a-z]+:", target):
            name, _, anchor = target.partition("#")
            path = (page.parent / name).resolve() if name else page
            assert path.exists(), target
            if anchor:
                assert anchor in slugs(path), target


def test_every_page_and_card_is_in_the_site():
    text = (DOCS / "index.md").read_text()
    for page in DOCS.glob("*.md"):
        if page.name != "index.md":
            assert f"\n{page.stem}\n" in text, page
    models = {path.parent.name for path in (ROOT / "models").glob("*/README.md")}
    assert {path.stem for path in (DOCS / "cards").glob("*.md")} == models
    for name in models:
        assert f"../../models/{name}/README.md" in (DOCS / "cards" / f"{name}.md").read_text()


def test_the_reference_lists_the_public_names():
    names = set(re.findall(r"^\| `skin\.(\w+)`", (DOCS / "api.md").read_text(), re.MULTILINE))
    assert names == set(skin.__all__)


def documented_commands(page: Path) -> list[list[str]]:
    """Return the words behind ``skin`` of each command in the code blocks of a page."""
    blocks = re.findall(r"^```(?:bash|sh)\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    matches = (re.match(r"(?:\S*/)?skin (?!-)([^|]+)", line) for line in lines)
    return [shlex.split(match[1], comments=True) for match in matches if match]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_name_existing_verbs_and_options(page):
    for verb, *words in documented_commands(page):
        assert verb in verbs()
        for word in words if "--config-dir" not in words else ():
            group, _, options = word.partition("=")
            if (ROOT / "conf" / group).is_dir():
                for option in options.split(","):
                    assert (ROOT / "conf" / group / f"{option}.yaml").exists(), word


def test_studies_that_pages_name_exist():
    files = (CONF / "study").glob("*.yaml")
    studies = {path.stem: set(OmegaConf.load(path).get("parts", ())) for path in files}
    for page in PAGES:
        text = "" if page.name == "CHANGELOG.md" else page.read_text()
        for name, parts in re.findall(r"\bstudy=(\w+)(?: study\.part=\[?([\w,]+))?", text):
            assert name in studies, (page, name)
            assert not parts or set(parts.split(",")) <= studies[name], (page, parts)


def test_files_that_pages_and_docstrings_name_exist():
    sources = [path for folder in ("skin", "experiments") for path in (ROOT / folder).rglob("*.py")]
    for page in [*PAGES, *sources]:
        text = "" if page.name == "CHANGELOG.md" else page.read_text()
        for name in re.findall(r"\b(?:tests/[\w/]+\.py|docs/results/\w+\.csv)", text):
            assert (ROOT / name).is_file(), (page, name)


PAGE = (ROOT / "docs" / "data.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.S)
LINES = {re.search(r"import (\w+)", block)[1]: block for block in BLOCKS}


@pytest.fixture(scope="module")
def position(tmp_path_factory):
    position = tmp_path_factory.mktemp("data")
    with initialize_config_dir(str(CONF), version_base="1.3"), pytest.MonkeyPatch.context() as patch:
        patch.setattr("skin.device.simulated._BATCH", 16)
        patch.setattr("skin.device.base._PART", 1)
        config = validate_config(compose("generate", ["simulator=naive", "n=48", "device.dead=1"]))
        generate_data_set(build_device(config), settings_of(config), position / "touches")
    return position


def peaks(folder) -> dict[int, float]:
    """Return the highest first reading of each dangerous gesture, by its number."""
    data, found = DataSet(folder), {}
    for number, first in enumerate(data.firsts):
        shard = read_recording(data.path(number))
        dangerous = shard.touches.labels[:, shard.task.names.index("dangerous")] == 1
        for row in torch.nonzero(dangerous).flatten().tolist():
            found[first + row] = float(shard.touches.readings[row, :, 0].max())
    return found


@pytest.mark.parametrize("library", sorted(LINES))
def test_a_library_reads_a_data_set_by_the_lines_of_the_page(library, position, monkeypatch):
    pytest.importorskip(library)
    monkeypatch.chdir(position)
    names = {}
    exec(LINES[library], names)
    found = names["peaks"]
    if library == "pandas":
        found = found.to_dict()
    else:
        found = dict(zip(found["simulation"].to_list(), found["reading_00"].to_list(), strict=True))
    expected = peaks(position / "touches")
    assert 10 < len(expected) < 48
    assert list(found) == sorted(expected)
    assert found == expected


def first_column(table: str) -> list[str]:
    """Return what is in code in the first column of a table."""
    return re.findall(r"`(\w+)`", " ".join(row.split("|")[1] for row in table.splitlines() if "|" in row))


def test_the_page_names_the_keys_of_the_manifest_and_the_columns(position):
    table = PAGE[PAGE.index("| key |") : PAGE.index("`touches/shards/00000.parquet` and so on")]
    named = first_column(table)
    assert sorted(named) == sorted(DataSet(position / "touches").manifest)
    table = PAGE[PAGE.index("| column |") : PAGE.index("## Training")]
    named = first_column(table)
    known = DataSet(position / "touches").manifest["columns"]
    assert {name for name in named if not name.endswith("_")} <= set(known)
    own = {name for name in known if not name.startswith(("reading_", "saturated_", "gesture_"))}
    assert own <= set(named)
