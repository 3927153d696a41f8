"""Bundles on the Hugging Face Hub, through `huggingface_hub` (extra `hub`), which keeps tokens and endpoints."""

import json
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from delayrl.deploy.files import DOCUMENT, GRAPH, LIMITS, WEIGHTS, check_files, check_target, read_files, write_files
from delayrl.errors import DelayRLError

CARD = "README.md"


def push(bundle: str | Path, repo: str, *, private: bool = False) -> str:
    """Upload a bundle, with a model card made from its metadata, as one commit; the repository is made where it lacks.

    Args:
        bundle: its folder; it is checked first.
        repo: OWNER/NAME.
        private: of a new repository.

    Returns:
        Where it lies.

    Raises:
        DelayRLError: a broken bundle, no access, no network.
    """
    metadata, files = read_files(bundle, (WEIGHTS, GRAPH))
    check_files(bundle, metadata, files)
    hub, api = _hub()
    with _one_line(f"cannot push to {repo}"):
        url = api.create_repo(repo, private=private, exist_ok=True)
        content = {CARD: card(metadata, repo).encode(), **files}
        operations = [hub.CommitOperationAdd(path_in_repo=name, path_or_fileobj=data) for name, data in content.items()]
        api.create_commit(repo, operations, commit_message=f"delayrl bundle {metadata['checksum'][:12]}")
    return str(url)


def pull(repo: str, out: str | Path, *, revision: str | None = None, force: bool = False) -> dict[str, Any]:
    """Download a bundle, check it aside, and put it into a new or empty folder; no other file is asked for.

    Returns:
        Its metadata.

    Raises:
        DelayRLError: no such repository, no bundle in it, a broken one, a folder that holds something else.
    """
    check_target(Path(out), force=force)
    _, api = _hub()
    names = [DOCUMENT, WEIGHTS, GRAPH]
    with tempfile.TemporaryDirectory(prefix="delayrl-pull-") as aside:
        with _one_line(f"cannot pull from {repo}"):
            sizes = {
                item.path: getattr(item, "size", None) for item in api.get_paths_info(repo, names, revision=revision)
            }
        for name in (name for name in names if name in sizes):
            size = sizes[name]
            if not isinstance(size, int) or size > LIMITS[name]:
                raise DelayRLError(f"{name} in {repo} is no file, or larger than {LIMITS[name]:,} bytes")
            with _one_line(f"cannot pull {name} from {repo}"):
                api.hf_hub_download(repo, name, revision=revision, local_dir=aside)
        if DOCUMENT not in sizes:
            raise DelayRLError(f"{repo} holds no policy bundle: it has no {DOCUMENT}")
        try:
            metadata, files = read_files(aside, (WEIGHTS, GRAPH))
            check_files(aside, metadata, files)
        except DelayRLError as error:
            raise DelayRLError(str(error).replace(aside, repo)) from error
    write_files(Path(out), files, force=force)
    return metadata


def card(metadata: Mapping[str, Any], repo: str) -> str:
    """The model card: what the metadata says, and how to use it."""
    policy, evaluation = metadata["policy"], metadata.get("evaluation")
    agent, env, delay = (plain(metadata.get(name)) for name in ("agent", "env", "delay"))
    head: dict[str, Any] = {"library_name": "delayrl", "pipeline_tag": "reinforcement-learning"}
    head["tags"] = ["reinforcement-learning", "delay", "delayrl", agent, env]
    lines = [f"# {agent} on {env}, delay {delay}", ""]
    lines += [
        "A policy for observations that arrive late: it takes the newest observation that has arrived, its age in "
        "steps, and the actions applied since.",
        "",
        "| | |",
        "| --- | --- |",
        f"| observation | {policy['obs_size']} numbers |",
        f"| action | {policy['action_size']} numbers |",
        f"| ages | 0 .. {policy['max_age']} |",
    ]
    lines += [f"| {name} | {plain(metadata.get(name))} |" for name in ("dt", "preset", "protocol", "seed", "step")]
    if isinstance(evaluation, Mapping):
        mean, spread, count, step = (
            plain(evaluation.get(name)) for name in ("mean_return", "std_return", "episodes", "step")
        )
        lines += [f"| return | {mean} ± {spread} (standard deviation of {count} episodes, at step {step}) |"]
    lines += [
        f"| checksum | {plain(metadata['checksum'])} |",
        "",
        "The return is raw, of the last evaluation of one training run under its protocol.",
        "",
        "```",
        "pip install 'delayrl[hub]'",
        f"delayrl pull {repo} --out bundle",
        "```",
        "",
        "```python",
        "from delayrl.deploy import load_bundle",
        "",
        'policy = load_bundle("bundle")  # weights and JSON; nothing in it is code',
        "action = policy(obs, actions, age)",
        "```",
        "",
    ]
    yaml = [f"{name}: {json.dumps(value)}" for name, value in head.items()]  # JSON is YAML
    return "\n".join(["---", *yaml, "---", "", *lines])


def plain(value: Any) -> str:
    """A value in a cell of a table: one short line without markup."""
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return "".join(c for c in text if c.isprintable() and c not in "|<>`[]")[:80]


def _hub() -> tuple[Any, Any]:
    try:
        import huggingface_hub
    except ImportError as error:
        raise DelayRLError("the hub takes the package huggingface_hub: pip install 'delayrl[hub]'") from error
    return huggingface_hub, huggingface_hub.HfApi()


@contextmanager
def _one_line(what: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # of the network, of its client, of its client's client: all end here
        line = "".join(filter(str.isprintable, (str(error).strip().splitlines() or [""])[0]))
        raise DelayRLError(f"{what}: {line[:200] or type(error).__name__}") from error
