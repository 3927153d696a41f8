"""push and pull with the real client, against a hub on this machine whose repositories are folders."""

import base64
import hashlib
import http.server
import json
import pickle
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import huggingface_hub
import pytest
from bundles import bundle_of, policy_of

from delayrl.cli.main import main
from delayrl.deploy import load_bundle, packing
from delayrl.deploy.files import LIMITS, WEIGHTS
from delayrl.deploy.hub import card, pull, push
from delayrl.errors import DelayRLError, DelayWarning

COMMIT = "0123456789" * 4
SITE = "https://huggingface.co/"  # the client checks the form of this address but does not use it


class Hub(http.server.ThreadingHTTPServer):
    """Repositories in `root`, and the files that were requested."""

    root: Path
    asked: list[str]
    sizes: dict[str, int]
    private: bool


class Handler(http.server.BaseHTTPRequestHandler):
    """The part of the hub's interface that push and pull need."""

    server: Hub

    def log_message(self, *args: Any) -> None:
        pass

    def reply(self, status: int, content: Any, **headers: str) -> None:
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def do_POST(self) -> None:
        hub, body = self.server, self.rfile.read(int(self.headers.get("Content-Length", 0)))
        parts = self.path.strip("/").split("/")
        if self.path == "/api/repos/create":
            given = json.loads(body)
            hub.private = given.get("private") is True or given.get("visibility") == "private"
            repo = f"{given['organization']}/{given['name']}"
            (hub.root / repo).mkdir(parents=True, exist_ok=True)
            self.reply(200, {"url": SITE + repo})
            return
        if self.path == "/api/validate-yaml":  # the hub checks the head of a model card before it accepts it
            self.reply(200, {"errors": [], "warnings": []})
            return
        home = hub.root / "/".join(parts[2:4])
        if not home.is_dir():
            self.reply(404, {"error": "no such repository"}, X_Error_Code="RepoNotFound")
        elif parts[4] == "preupload":
            files = json.loads(body)["files"]
            modes = [{"path": f["path"], "uploadMode": "regular", "shouldIgnore": False} for f in files]
            self.reply(200, {"files": modes})
        elif parts[4] == "commit":
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    (home / line["value"]["path"]).write_bytes(base64.b64decode(line["value"]["content"]))
                if line["key"] == "deletedFile":
                    (home / line["value"]["path"]).unlink()
            url = f"{SITE}{'/'.join(parts[2:4])}/commit/{COMMIT}"
            self.reply(200, {"commitOid": COMMIT, "commitUrl": url, "success": True})
        elif parts[4] == "paths-info":
            names = parse_qs(body.decode())["paths"]
            files = [home / name for name in names if (home / name).is_file()]
            sizes = {file.name: hub.sizes.get(file.name, file.stat().st_size) for file in files}
            self.reply(200, [{"type": "file", "path": n, "size": s, "oid": "0" * 40} for n, s in sizes.items()])
        else:
            self.reply(404, {"error": "not found"})

    def do_GET(self) -> None:
        hub, parts = self.server, self.path.partition("?")[0].strip("/").split("/")
        if parts[:2] == ["api", "models"]:
            known = (hub.root / "/".join(parts[2:4])).is_dir()
            self.reply(200 if known else 404, {"id": "/".join(parts[2:4]), "sha": COMMIT})
            return
        file = hub.root / "/".join(parts[:2]) / "/".join(parts[4:])
        if parts[2:4] != ["resolve", COMMIT] or not file.is_file():  # no branch, which could have moved
            self.reply(404, {"error": "not found"}, X_Error_Code="EntryNotFound")
            return
        if self.command == "GET":
            hub.asked.append(file.name)
        data = file.read_bytes()
        self.reply(200, data, ETag=f'"{hashlib.sha256(data).hexdigest()}"', X_Repo_Commit=COMMIT)

    do_HEAD = do_GET  # noqa: N815


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    server = Hub(("127.0.0.1", 0), Handler)
    server.root, server.asked, server.sizes, server.private = tmp_path / "hub", [], {}, False
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
    client = partial(huggingface_hub.HfApi, endpoint=f"http://127.0.0.1:{server.server_port}", token="none")
    monkeypatch.setattr(huggingface_hub, "HfApi", client)
    monkeypatch.setenv("HF_HUB_DISABLE_PROGRESS_BARS", "1")
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    evaluation = {"step": 15000, "episodes": 10, "mean_return": 987.654321, "std_return": 1.5, "protocol": "corrected"}
    return bundle_of(tmp_path / "bundle", policy_of("vdpo"), evaluation=evaluation, agent="vdpo")


def test_there_and_back(hub: Hub, bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["push", str(bundle), "some/pendulum"])
    assert "/some/pendulum" in capsys.readouterr().out
    (hub.root / "some/pendulum/evil.pkl").write_bytes(b"not asked for")
    main(["pull", "some/pendulum", "--out", str(tmp_path / "back")])
    assert "vdpo on Reacher-v5, ages 0..4" in capsys.readouterr().out
    names = sorted(file.name for file in bundle.iterdir())
    assert sorted(file.name for file in (tmp_path / "back").iterdir()) == names
    for name in names:
        assert (tmp_path / "back" / name).read_bytes() == (bundle / name).read_bytes()
    assert hub.asked == ["bundle.json", "policy.safetensors", "policy.onnx"]
    load_bundle(tmp_path / "back", "onnx")


def test_no_graph_of_another_policy_stays(hub: Hub, bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    push(bundle, "some/pendulum")
    monkeypatch.setattr(packing, "find_spec", lambda name: None)
    with pytest.warns(DelayWarning, match="the bundle has no policy.onnx"):
        other = bundle_of(bundle.with_name("other"), policy_of("bpql"))
    push(other, "some/pendulum")
    assert sorted(file.name for file in (hub.root / "some/pendulum").iterdir()) == ["README.md", "bundle.json", WEIGHTS]


def test_card(hub: Hub, bundle: Path) -> None:
    push(bundle, "some/pendulum", private=True)
    assert hub.private
    text = (hub.root / "some/pendulum/README.md").read_text()
    head = text.split("---")[1]
    assert 'library_name: "delayrl"' in head
    for words in ("vdpo on Reacher-v5, delay 4", "0 .. 4", "987.654 ± 1.5", "at step 15000"):
        assert words in text
    assert load_bundle(bundle).metadata["checksum"] in text


def test_cards_are_text() -> None:
    """Names from foreign metadata stay in their cells."""
    evil = "x\n---\n<script>alert(1)</script> | [link](http://evil) \x1b[31m" + "y" * 1000
    metadata = {"agent": evil, "env": evil, "delay": evil, "checksum": "0"}
    metadata["policy"] = {"obs_size": 1, "action_size": 1, "max_age": 0}
    text = card(metadata, "some/pendulum")
    assert "delayrl pull some/pendulum --out bundle" in text
    assert "<" not in text
    assert "\x1b" not in text
    assert text.count("\n---\n") == 1
    assert max(map(len, text.splitlines())) < 500


def test_a_bundle_that_is_broken_is_not_pushed(hub: Hub, bundle: Path) -> None:
    (bundle / WEIGHTS).write_bytes(b"")
    with pytest.raises(DelayRLError, match="cut or changed"):
        push(bundle, "some/pendulum")
    assert not hub.root.exists()


def test_what_is_broken_does_not_arrive(hub: Hub, bundle: Path, tmp_path: Path) -> None:
    """Nothing is left in the target or beside it, and the message has no local path."""
    push(bundle, "some/pendulum")
    home, out = hub.root / "some/pendulum", tmp_path / "back"
    before = sorted(tmp_path.iterdir())

    def refused(words: str) -> None:
        with pytest.raises(DelayRLError, match=words) as error:
            pull("some/pendulum", out)
        assert "\n" not in str(error.value)
        assert "/tmp" not in str(error.value)
        assert sorted(tmp_path.iterdir()) == before

    weights = (home / WEIGHTS).read_bytes()
    (home / WEIGHTS).write_bytes(pickle.dumps([1, 2]))
    refused("some/pendulum/policy.safetensors is cut or changed")
    (home / WEIGHTS).unlink()
    refused("is missing")
    (home / WEIGHTS).write_bytes(weights)
    hub.asked.clear()
    hub.sizes = {"bundle.json": LIMITS["bundle.json"] + 1}
    refused("larger than")
    assert hub.asked == []
    hub.sizes = {}
    document = json.loads((home / "bundle.json").read_text())
    document["files"]["../../../evil"] = document["files"][WEIGHTS]
    (home / "bundle.json").write_text(json.dumps(document))
    refused("checksum")
    (home / "bundle.json").unlink()
    refused("some/pendulum holds no policy bundle")


def test_pull_overwrites_nothing(hub: Hub, bundle: Path, tmp_path: Path) -> None:
    push(bundle, "some/pendulum")
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    for force in (False, True):
        with pytest.raises(DelayRLError, match="not empty"):
            pull("some/pendulum", out, force=force)
    assert [file.name for file in out.iterdir()] == ["mine.txt"]
    with pytest.raises(DelayRLError, match="not empty"):
        pull("some/pendulum", bundle)
    pull("some/pendulum", bundle, force=True)
    hub.asked.clear()
    with pytest.raises(DelayRLError, match="not empty"):
        pull("no/where", out)  # before anything is asked for
    assert hub.asked == []


def test_the_hub_says_no(hub: Hub, bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command, words in (
        (["pull", "some/where", "--out", str(tmp_path / "back")], "cannot pull from some/where: "),
        (["push", str(bundle), "not a name"], "cannot push to not a name: "),
    ):
        with pytest.raises(SystemExit) as end:
            main(command)
        out, err = capsys.readouterr()
        assert (end.value.code, out, err.count("\n")) == (2, "", 1)
        assert words in err
