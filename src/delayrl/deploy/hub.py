"""Push and pull bundles on the Hugging Face Hub. `huggingface_hub` (extra `hub`) holds tokens and endpoints."""

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from delayrl.deploy.files import DOCUMENT, GRAPH, LIMITS, WEIGHTS, check_files, check_target, read_files, write_files
from delayrl.errors import DelayRLError, one_line

CARD = "README.md"
LONGEST_MESSAGE = 200
"""Characters that are shown of what a server says."""


CARD_TEXT = """\
---
library_name: "delayrl"
pipeline_tag: "reinforcement-learning"
tags: {tags}
---

# {agent} on {env}, delay {delay}

A policy for observations that arrive late: it takes the newest observation that has arrived, its age in steps, and \
the actions applied since.

| | |
| --- | --- |
{table}

The return is raw, of the last evaluation of one training run under its protocol.

```
pip install 'delayrl[hub]'
delayrl pull {repo} --out bundle
```

```python
from delayrl.deploy import load_bundle

policy = load_bundle("bundle")  # reads weights and JSON, and runs no code of the bundle
action = policy(obs, actions, age)
```
"""


def push(bundle: str | Path, repo: str, *, private: bool = False) -> str:
    """Upload a bundle and a model card made from its metadata, as one commit; return the address of the repository.

    Args:
        bundle: the folder of the bundle, which is checked first.
        repo: OWNER/NAME; it is created if needed.
        private: whether a new repository is private.

    Raises:
        DelayRLError: a broken bundle, no access, or no network.
    """
    metadata, files = read_files(bundle, (WEIGHTS, GRAPH))
    check_files(bundle, metadata, files)
    hub, api = _hub()
    with one_line(f"cannot push to {repo}", LONGEST_MESSAGE):
        url = api.create_repo(repo, private=private, exist_ok=True)
        content = {CARD: card(metadata, repo).encode(), **files}
        operations: list[Any] = [hub.CommitOperationAdd(name, data) for name, data in content.items()]
        if GRAPH not in files and api.get_paths_info(repo, [GRAPH]):  # of another policy
            operations.append(hub.CommitOperationDelete(GRAPH))
        api.create_commit(repo, operations, commit_message=f"delayrl bundle {metadata['checksum'][:12]}")
    return str(url)


def pull(repo: str, out: str | Path, *, revision: str | None = None, force: bool = False) -> dict[str, Any]:
    """Download a bundle and check it, then move it into a folder; return the content of its bundle.json.

    Args:
        repo: OWNER/NAME. No other file of it is requested.
        out: a new or empty folder.
        revision: a branch, tag or commit; None for the default branch.
        force: replace a bundle in `out`.

    Raises:
        DelayRLError: no such repository, no bundle in it or a broken one, or a folder that holds something else.
    """
    check_target(Path(out), force=force)
    _, api = _hub()
    names = [DOCUMENT, WEIGHTS, GRAPH]
    with tempfile.TemporaryDirectory(prefix="delayrl-pull-") as folder:
        with one_line(f"cannot pull from {repo}", LONGEST_MESSAGE):
            revision = api.repo_info(repo, revision=revision).sha  # what is checked is what is downloaded
            paths = api.get_paths_info(repo, names, revision=revision)
            sizes = {path.path: getattr(path, "size", None) for path in paths}
        for name in (name for name in names if name in sizes):
            size = sizes[name]
            if not isinstance(size, int) or size > LIMITS[name]:
                raise DelayRLError(f"{name} in {repo} is not a file, or is larger than {LIMITS[name]:,} bytes")
            with one_line(f"cannot pull {name} from {repo}", LONGEST_MESSAGE):
                api.hf_hub_download(repo, name, revision=revision, local_dir=folder)
        if DOCUMENT not in sizes:
            raise DelayRLError(f"{repo} holds no policy bundle: it has no {DOCUMENT}")
        try:
            metadata, files = read_files(folder, (WEIGHTS, GRAPH))
            check_files(folder, metadata, files)
        except DelayRLError as error:
            raise DelayRLError(str(error).replace(folder, repo)) from error
    write_files(Path(out), files, force=force)
    return metadata


def card(metadata: Mapping[str, Any], repo: str) -> str:
    """Return the model card: the metadata as a table, and how to use the bundle."""
    policy, evaluation = metadata["policy"], metadata.get("evaluation")
    agent, env, delay = (plain(metadata.get(name)) for name in ("agent", "env", "delay"))
    cells = {
        "observation": f"{policy['obs_size']} numbers",
        "action": f"{policy['action_size']} numbers",
        "ages": f"0 .. {policy['max_age']}",
        **{name: plain(metadata.get(name)) for name in ("dt", "preset", "protocol", "seed", "step")},
    }
    if isinstance(evaluation, Mapping):
        names = ("mean_return", "std_return", "episodes", "step")
        mean, spread, count, step = (plain(evaluation.get(name)) for name in names)
        around = "" if evaluation.get("std_return") is None else f" ± {spread}"
        cells["return"] = f"{mean}{around} (mean ± standard deviation of {count} episodes, at step {step})"
    cells["checksum"] = plain(metadata["checksum"])
    table = "\n".join(f"| {name} | {value} |" for name, value in cells.items())
    tags = json.dumps(["reinforcement-learning", "delay", "delayrl", agent, env])  # JSON is YAML
    return CARD_TEXT.format(agent=agent, env=env, delay=delay, table=table, tags=tags, repo=repo)


def plain(value: Any) -> str:
    """Return a value as the cell of a table: one short line without markup."""
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return "".join(c for c in text if c.isprintable() and c not in "|<>`[]")[:80]


def _hub() -> tuple[Any, Any]:
    with one_line("the hub cannot be reached"):
        import huggingface_hub
    return huggingface_hub, huggingface_hub.HfApi()
