"""The documentation holds what it says: links, pictures, commands, options and configuration keys exist."""

from __future__ import annotations

import importlib
import re
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import pytest
import typer
import yaml

from agent.config.documents import merged
from agent.config.reading import config_from
from agent.config.tables import FleetConfig, SensorsTable
from agent.errors import ConfigError
from agent.exit_codes import ExitCode
from agent.sensing.clock import require_epoch
from agent.uwb.adapter import UwbAdapter
from agent.watch.health import assess
from estimators.integrity.finding import Finding, Gravity, What
from fleetloc import UwbFrame, encode_uwb_json
from fleetloc.cli import build_app
from fleetloc.whole_config import OTHER_TABLES, whole
from sim_bridge.sitl.mission import load_mission
from tests.support.command_names import complaint
from tests.support.doc_pages import DOCS, FENCE, PAGES, ROOT, Block, blocks, written_commands
from transport.errors import Reason
from transport.messages.header import MAX_DATAGRAM_BODY_BYTES, SIGNATURE_BYTES
from transport.messages.information_body import content_bytes
from transport.messages.measurement_body import RECORD_BYTES, MeasurementKind
from transport.messages.proofs import acks_bytes

SITE = ROOT / "mkdocs.yml"
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
ROOMS = "configs|tests|estimators|transport|agent|sim_bridge|fleetloc"
OURS = re.compile(rf"(?<![\w/.])(?:{ROOMS})/(?:[\w-]+/)*[\w-]+\.(?:py|toml)\b")
TABLES = {field.name for field in msgspec.structs.fields(FleetConfig)} - {"others"} | OTHER_TABLES.keys()


def prose(page: Path) -> str:
    """A page without its fenced blocks and inline code, where brackets mean other things."""
    return re.sub(r"`[^`\n]*`", "", FENCE.sub("", page.read_text(encoding="utf-8")))


# --- version ----------------------------------------------------------------------------------------------------


def test_the_changelog_begins_with_the_version_that_is_built() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    section = re.search(r"^## \[(.+)\] - (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert section is not None
    assert section[1] == version.removesuffix(".dev0")
    expected = "unreleased" if version.endswith(".dev0") else r"\d{4}-\d\d-\d\d"
    assert re.fullmatch(expected, section[2])


# --- links ----------------------------------------------------------------------------------------------------


def slugs(page: Path) -> set[str]:
    """The anchors of a page's headings, as mkdocs and the usual forges make them."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading.lower()).strip()) for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_relative_link_and_picture_is_there(page: Path) -> None:
    for target in LINK.findall(prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        found = page if not name else (page.parent / name)
        assert found.exists(), f"{page.name}: {target}: no such file"
        assert page.parent != DOCS or found.resolve().is_relative_to(DOCS), f"{page.name}: {target}: not in the site"
        if anchor:
            assert anchor in slugs(found), f"{page.name}: {target}: no such heading; there are {sorted(slugs(found))}"


def test_the_site_names_every_page_once_and_no_other() -> None:
    site = yaml.safe_load(SITE.read_text(encoding="utf-8"))
    named = [page for section in site["nav"] for entries in section.values() for e in entries for page in e.values()]
    assert sorted(named) == sorted(page.name for page in DOCS.glob("*.md"))


def test_pictures_are_small() -> None:
    for picture in (DOCS / "images").iterdir():
        assert picture.stat().st_size < 200_000, f"{picture.name}: expected less than 200 kB"


# --- commands -------------------------------------------------------------------------------------------------


def test_every_command_and_option_shown_exists() -> None:
    app = typer.main.get_command(build_app())
    shown = list(written_commands())
    wrong = [f"{page}: fleetloc {text}: {found}" for page, text in shown if (found := complaint(app, text))]
    assert not wrong, "\n".join(wrong)
    assert len(shown) > 50


def test_a_wrong_command_or_option_would_be_found() -> None:
    app = typer.main.get_command(build_app())
    assert complaint(app, "fly configs/line3.toml") is not None
    assert complaint(app, "fleet configs/line3.toml --losss 0.1") is not None
    assert complaint(app, "keys innit fleet.toml") is not None
    assert complaint(app, "bench loss --runs 20 | head -n 3") is None


def test_every_file_of_ours_that_is_named_exists() -> None:
    for page in PAGES:
        for name in OURS.findall(page.read_text(encoding="utf-8")):
            assert (ROOT / name).exists(), f"{page.name}: {name}: no such file"


# --- configuration --------------------------------------------------------------------------------------------


def stub() -> dict[str, Any]:
    """A fleet over which a fragment is laid."""
    agents = [{"id": i, "mavlink": f"udpin:127.0.0.1:{14_550 + i}"} for i in range(1, 10)]
    origin = {"lat_deg": 47.0, "lon_deg": 8.0, "alt_m": 400.0}
    return {"fleet": {"name": "shown", "origin": origin}, "agents": agents}


def toml_blocks() -> list[Block]:
    return [block for block in blocks() if block.language == "toml"]


@pytest.mark.parametrize("block", toml_blocks(), ids=lambda block: block.page)
def test_every_toml_block_is_accepted(block: Block, tmp_path: Path) -> None:
    document = tomllib.loads(block.text)
    if "takeoff_m" in document:
        mission = tmp_path / "mission.toml"
        mission.write_text(block.text, encoding="utf-8")
        load_mission(mission, config_from(stub(), "stub"))
        return
    assert document.keys() <= TABLES, f"{block.page}: begin the block with the header of its table"
    whole(config_from(merged(stub(), document), block.page))


def test_the_first_configuration_is_whole() -> None:
    """GIVEN the first block of the newcomer's page WHEN it is read by itself THEN it is a configuration."""
    first = next(block for block in toml_blocks() if block.page == "first-configuration.md")
    config = config_from(tomllib.loads(first.text), first.page)
    assert config.ids == (1, 2, 3)


def known_keys() -> set[str]:
    """Every ``table.key`` of the configuration and the tables inside tables, former keys left out."""
    page = (DOCS / "configuration.md").read_text(encoding="utf-8").partition("\n# Former keys")[0]
    keys: set[str] = set()
    for heading, body in re.findall(r"^##+ (`\[+[\w.]+\]+`.*?)$(.*?)(?=^##|\Z)", page, re.MULTILINE | re.DOTALL):
        table = re.sub(r"[`\[\]]", "", heading).split(",")[0]
        keys |= {table} | {f"{table}.{key}" for key in re.findall(r"^\| `(\w+)` \|", body, re.MULTILINE)}
    return keys


def test_every_key_that_a_page_names_exists() -> None:
    """GIVEN ``table.key`` in the text of a page WHEN the table is one of the configuration THEN so is the key."""
    keys = known_keys()
    tables = {key.partition(".")[0] for key in keys}
    assert len(keys) > 100
    wrong, seen = [], 0
    for page in PAGES:
        if page.name in ("configuration.md", "CHANGELOG.md"):  # these name former keys
            continue
        text = FENCE.sub("", page.read_text(encoding="utf-8"))
        for name in re.findall(r"`(?:--set )?([a-z]+(?:\.\w+)+)\b(?![/(])", text):
            if name.partition(".")[0] in tables and not name.endswith((".py", ".toml", ".md")):
                seen += 1
                if re.sub(r"\.\d+\.", ".", name) not in keys:
                    wrong.append(f"{page.name}: {name}")
    assert not wrong, wrong
    assert seen > 50


# --- the driver -----------------------------------------------------------------------------------------------


def test_the_shown_uwb_driver_makes_frames_that_the_daemon_takes() -> None:
    """GIVEN the script of docs/uwb.md WHEN it frames lines of a module THEN the daemon has their ranges."""
    script = next(block.text for block in blocks() if block.page == "uwb.md" and block.language == "python")
    names: dict[str, Any] = {"__name__": "uwb_publisher"}
    exec(compile(script, "docs/uwb.md", "exec"), names)
    daemon = UwbAdapter(1, (2, 3), SensorsTable())

    def receive(line: str, seq: int) -> list[tuple[int, float, float]]:
        frame = encode_uwb_json(UwbFrame(seq, "mono", 49_990_000_000 + seq, (names["range_of"](line),), 1))
        samples = daemon.receive(frame, now_s=100.0, host_s=50.0, unix_s=1.8e9)
        return [(sample.target, sample.range_m, sample.sigma_m) for sample in samples]

    assert receive("2 12.34 0.2", 0) == [(2, 12.34, 0.2)]
    assert receive("3 5.5", 1) == [(3, 5.5, SensorsTable().uwb_sigma_m)]
    with pytest.raises(ValueError, match="could not convert"):
        names["range_of"]("2 far")


def test_the_shown_json_frame_is_one() -> None:
    shown = next(block.text for block in blocks() if block.page == "uwb.md" and block.language == "json")
    daemon = UwbAdapter(1, (2,), SensorsTable())
    (sample,) = daemon.receive(shown.encode(), now_s=100.0, host_s=81.794643123, unix_s=1.8e9)
    assert (sample.target, sample.range_m, sample.sigma_m) == (2, 12.345, 0.10)


# --- troubleshooting ------------------------------------------------------------------------------------------


def troubleshooting() -> str:
    return (DOCS / "troubleshooting.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "found",
    [
        Finding(What.NO_ESTIMATE, Gravity.ABSENT, detail="waiting for fixes"),
        Finding(What.FELL_BACK, Gravity.DEGRADED),
        Finding(What.NO_DATA, Gravity.DEGRADED),
        Finding(What.UNKNOWN, Gravity.UNUSABLE),
        Finding(What.UNCERTAIN, Gravity.DEGRADED),
        Finding(What.AMBIGUOUS, Gravity.ALARM),
        Finding(What.TOO_FEW_RANGED, Gravity.ALARM, value=2, limit=3),
        Finding(What.ONE_PLANE, Gravity.ALARM),
        Finding(What.AUTOPILOT, Gravity.DEGRADED, detail="searching"),
        Finding(What.AUTOPILOT, Gravity.DEGRADED, detail="lost"),
        Finding(What.IMU_GAP, Gravity.DEGRADED),
        Finding(What.NO_FIX, Gravity.DEGRADED),
        Finding(What.UNAIDED, Gravity.DEGRADED),
        (Finding(What.SILENT, Gravity.DEGRADED, 2), Finding(What.SILENT, Gravity.DEGRADED, 3)),
    ],
    ids=lambda found: "",
)
def test_every_reason_of_health_is_explained(found: Finding | tuple[Finding, ...]) -> None:
    (reason,) = assess(found if isinstance(found, tuple) else (found,)).reasons
    assert f"| `{reason}` |" in troubleshooting()


def test_the_reasons_of_refusal_that_are_explained_exist() -> None:
    section = troubleshooting().partition("### Refused packets")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (`.*?) \|", section, re.MULTILINE)
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert len(named) > 10
    assert set(named) <= {reason.value for reason in Reason}


def test_the_daemons_own_exit_codes_are_the_ones_told() -> None:
    told = {int(code) for code in re.findall(r"exit (\d)", troubleshooting())}
    assert told <= {int(code) for code in ExitCode}


# --- the walks ------------------------------------------------------------------------------------------------


def walks() -> dict[str, list[tuple[str, str, str]]]:
    """(room, file, function) of each row of each walk in the page on architecture."""
    section = (
        (DOCS / "architecture.md").read_text(encoding="utf-8").partition("## Five walks\n")[2].partition("\n## ")[0]
    )
    found: dict[str, list[tuple[str, str, str]]] = {}
    for walk in section.split("\n### ")[1:]:
        rows = re.findall(r"^\| (\w*) ?\| `([\w/.]+)` \| `([\w.]+)` \|", walk, re.MULTILINE)
        found[walk.partition("\n")[0]] = rows
    return found


@pytest.mark.parametrize("walk", walks())
def test_each_walk_enters_a_room_once(walk: str) -> None:
    rows = walks()[walk]
    entered = [room for room, _, _ in rows if room]
    assert rows[0][0]
    assert len(set(entered)) == len(entered) >= 2
    room = ""
    for name, file, _ in rows:
        room = name or room
        assert file.startswith(f"{room}/"), f"{walk}: {file} stands under {room}"


@pytest.mark.parametrize("walk", walks())
def test_the_functions_of_each_walk_are_in_their_files(walk: str) -> None:
    for _, file, function in walks()[walk]:
        found: Any = importlib.import_module(file.removesuffix(".py").replace("/", "."))
        for name in function.split("."):
            assert hasattr(found, name), f"{walk}: {file} has no {function}"
            found = getattr(found, name)


def test_there_are_five_walks() -> None:
    assert len(walks()) == 5
    assert all(len(rows) > 8 for rows in walks().values())


# --- refused configurations -----------------------------------------------------------------------------------

MISTAKES = {
    "a misspelt key": {"estimator": {"windw": 3}},
    "a former key": {"mavlink": {"rate_floor": 0.5}},
    "a key that is missing": {"agents": [{"id": 1}]},
    "one address twice": {"agents": [{"id": i, "mavlink": "udpin:127.0.0.1:14551"} for i in (1, 2)]},
    "a slow serial line": {"agents": [{"id": 1, "mavlink": "serial:/dev/ttyS1:57600"}]},
    "no address on the radio": {
        "agents": [{"id": 1, "mavlink": "udpin:127.0.0.1:14551", "listen": ["tcp/127.0.0.1:7447"]}],
        "transport": {"link": "udp"},
    },
    "shares beyond the period": {"transport": {"rounds_fraction": 0.9}},
    "a guard beyond the exchange": {"transport": {"guard_s": 0.5}},
    "an epoch of the future": {"fleet": {"epoch_unix_s": 5e9}},
    "an estimator that no drone can have": {"estimator": {"kind": "centralized_ekf"}},
    "no port": {"agents": [{"id": 1, "mavlink": "udpin:127.0.0.1:14551", "listen": ["tcp/127.0.0.1:99999"]}]},
}
TOLD_ELSEWHERE = ("`--out:", "`security: keys", "`warning: ...`")
"""Rows of other causes than a mistake in the file."""


def refusal(mistake: dict[str, Any]) -> str:
    """What a configuration with a mistake is refused with."""
    tables = merged(stub(), {})
    tables["agents"] = mistake.get("agents", tables["agents"])
    try:
        config = config_from(merged(tables, {k: v for k, v in mistake.items() if k != "agents"}), "fleet.toml")
    except ConfigError as error:
        return str(error)
    with pytest.raises(ConfigError) as refused:
        require_epoch(config, unix_s=1.8e9)
    return str(refused.value)


def test_the_refusals_that_are_explained_are_those_that_are_given() -> None:
    """GIVEN each row on refused configurations WHEN that mistake is made THEN its words are those of the row."""
    section = troubleshooting().partition("## A configuration is refused")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (`[^`]+`).*? \|", section, re.MULTILINE)
    given = [refusal(mistake) for mistake in MISTAKES.values()]
    for row in rows:
        if not row.startswith(TOLD_ELSEWHERE):
            words = re.sub(r"\\\.\\\.\\\.|\b[A-Z]+\b", ".*", re.escape(row.strip("`")))
            assert any(re.search(words, line) for line in given), (row, given)
    assert len(rows) - len(TOLD_ELSEWHERE) == len(MISTAKES)


# --- the wire -------------------------------------------------------------------------------------------------


def budget(row: str) -> list[int]:
    """The numbers for three, five and ten drones in the first row of the budget that begins so."""
    page = (DOCS / "architecture.md").read_text(encoding="utf-8").partition("**The budget.**")[2]
    line = next(line for line in page.splitlines() if line.startswith(f"| {row}"))
    return [int(re.findall(r"\d+", cell)[0]) for cell in line.split("|")[2:5]]


def test_the_budget_of_the_wire_is_that_of_the_codecs() -> None:
    """GIVEN the sizes of measurements on the wire WHEN a tick is added up THEN the page says so."""
    sizes = RECORD_BYTES
    fix = sizes[MeasurementKind.POSITION] + sizes[MeasurementKind.VELOCITY] + sizes[MeasurementKind.ACCELERATION]
    own = [fix + (n - 1) * sizes[MeasurementKind.RANGE] for n in (3, 5, 10)]
    assert budget("own measurements of a tick") == own
    records = [3 + n - 1 for n in (3, 5, 10)]
    fleets = list(zip((3, 5, 10), own, records, strict=True))
    proof = 4 + SIGNATURE_BYTES
    assert budget("unsigned, second exchange") == [n * s for n, s, _ in fleets]
    assert budget("unsigned, own ticks in one packet") == [MAX_DATAGRAM_BODY_BYTES // s for s in own]
    assert budget("signed, first exchange") == [s + proof + r for _, s, r in fleets]
    acknowledged = [(n - 1) * (s + proof + r) + acks_bytes((n - 1) * r) for n, s, r in fleets]
    assert budget("signed, second exchange") == acknowledged
    ticks = [(MAX_DATAGRAM_BODY_BYTES - proof) // (s + r) for _, s, r in fleets]
    assert budget("signed, own ticks under one proof") == ticks
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    told = re.findall(
        r"position (\d+), velocity (\d+), speed (\d+), range (\d+), anchor range (\d+), acceleration (\d+), and with "
        r"\S+ \S+ orientation (\d+), range between antennas (\d+), speed of an antenna (\d+); "
        r"\S+ (\d+), height above ground (\d+); with a camera sighting (\d+); "
        r"velocity of another sensor than the receiver (\d+)",
        page,
    )
    assert [int(size) for size in told[0]] == [sizes[kind] for kind in MeasurementKind]
    pairs = [content_bytes(n, double=False) for n in (3, 5, 10)]
    assert "{}, {}, {} for 3, 5, 10 agents in float32".format(*pairs) in page
