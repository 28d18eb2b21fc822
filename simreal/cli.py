"""The command line: `simreal list | train | evaluate | replay | sweep | doctor`.

Exit codes: 0 done; 2 the input is wrong (one line on stderr); 3 a `--require` does not hold; 130 interrupted.
JAX is imported only by the commands that compute.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from simreal.errors import UserError
from simreal.stopping import Interrupted

if TYPE_CHECKING:
    from simreal.config import RunConfig

DONE, WRONG_INPUT, REQUIREMENT_FAILED, INTERRUPTED = 0, 2, 3, 130
TRAIN_OPTIONS = ("--out", "--resume", "--from", "--seeds", "--help")


class _Parser(argparse.ArgumentParser):
    """Reports what is wrong with the arguments as every other error is reported: in one line."""

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message}; '{self.prog} --help' shows what is valid")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns its exit code."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA logs pages about programs that its cache holds
    try:
        return _run(list(sys.argv[1:] if arguments is None else arguments))
    except UserError as error:
        print(f"simreal: {' '.join(str(error).split())}", file=sys.stderr)
        return WRONG_INPUT
    except Interrupted as interruption:
        print(f"simreal: {interruption}", file=sys.stderr)
        return INTERRUPTED
    except KeyboardInterrupt:
        print("simreal: interrupted at once; what was saved before is intact", file=sys.stderr)
        return INTERRUPTED
    except PermissionError as error:
        print(f"simreal: {error.filename}: {error.strerror}", file=sys.stderr)
        return WRONG_INPUT
    except BrokenPipeError:  # the reader, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE


def _run(arguments: list[str]) -> int:
    parser = _Parser(
        prog="simreal",
        description="Train policies in randomised worlds, and measure how well they transfer.",
        allow_abbrev=False,
    )
    from simreal import __version__

    parser.add_argument("--version", action="version", version=f"simreal {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)
    for name, (summary, build, _) in COMMANDS.items():
        sub = commands.add_parser(
            name,
            help=summary,
            description=summary,
            allow_abbrev=False,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if arguments[:1] == [name]:
            build(sub)
    overrides: dict[str, Any] = {}
    if arguments[:1] == ["train"]:
        from simreal.config_files import split_overrides

        overrides, rest = split_overrides(arguments[1:], own=TRAIN_OPTIONS)
        arguments = ["train", *rest]
    given = parser.parse_args(arguments)
    given.overrides = overrides
    return COMMANDS[given.command][2](given)


def _build_list(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("environment", nargs="?", help="show the factors and sets of worlds of this one")


def _list(given: argparse.Namespace) -> int:
    from simreal import listing

    print(listing.overview() if given.environment is None else listing.environment(given.environment))
    return DONE


def _build_train(parser: argparse.ArgumentParser) -> None:
    from simreal.config_keys import config_keys

    parser.usage = (
        "simreal train CONFIG [--key.path VALUE ...] [--out DIR] [--seeds N] [--resume] [--from RUN]\n"
        "       simreal train --resume --out DIR"
    )
    parser.add_argument(
        "config", metavar="CONFIG", nargs="?", help="name of a shipped configuration, or a YAML file"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="run folder; default: runs/CONFIG-SEED")
    parser.add_argument(
        "--resume", action="store_true", help="go on from the newest checkpoint in the folder"
    )
    parser.add_argument(
        "--seeds",
        type=int,
        metavar="N",
        help="train N seeds, from --seed on, in one program, each into a folder of its own in DIR",
    )
    parser.add_argument(
        "--from", type=Path, metavar="RUN", dest="from_run", help="start from the policy of another run"
    )
    lines = ["keys of the configuration, each an option:"]
    for name, key in config_keys().items():
        lines.append(f"  --{name} {key.kind}{f' ({key.default})' if key.default else ''}")
        lines += textwrap.wrap(key.description, 100, initial_indent=" " * 6, subsequent_indent=" " * 6)
    parser.epilog = "\n".join(lines)


def _train(given: argparse.Namespace) -> int:
    from simreal.config_files import load_config, shipped_configs
    from simreal.runs import Run, new_folder, newest_folder

    source = given.config
    if source is None and given.seeds is not None:
        raise UserError("train: --seeds needs CONFIG, with --resume too")
    if source is None and given.resume and given.out is not None:
        source = Run.open(given.out).config_file
    if source is None:
        raise UserError(
            f"train: no CONFIG; valid: {', '.join(shipped_configs())}, or the path of a YAML file"
        )
    config = load_config(source, given.overrides)
    # The resolved file of a run is always called config.yaml, which names nothing.
    name = config.environment if Path(source).name == "config.yaml" else Path(source).stem
    out = given.out or (newest_folder if given.resume else new_folder)(name, config.seed)
    if given.seeds is not None:
        return _train_seeds(given, config, out)
    _set_up_jax()
    from simreal.training import train

    train(config, out, resume=given.resume, from_run=given.from_run)
    return DONE


def _train_seeds(given: argparse.Namespace, config: RunConfig, out: Path) -> int:
    """Several seeds of a configuration as one population."""
    if not 1 <= given.seeds <= 2**32 - config.seed:
        raise UserError(f"--seeds: must be at least 1, and the last seed below 2**32, got {given.seeds}")
    if given.from_run is not None:
        raise UserError("--seeds and --from exclude each other: a population starts from nothing")
    seeds = range(config.seed, config.seed + given.seeds)
    _set_up_jax()
    from simreal.training import train_population

    configs = [dataclasses.replace(config, seed=seed) for seed in seeds]
    train_population(configs, [out / f"seed-{seed}" for seed in seeds], out, given.resume)
    return DONE


def _build_evaluate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN", help="a run folder")
    parser.add_argument(
        "--sets", metavar="NAME,...", help="sets of worlds; default: all of the environment's"
    )
    parser.add_argument(
        *("--range", "-r"),
        action="append",
        default=[],
        dest="ranges",
        metavar="FACTOR=LOW:HIGH",
        help="also a set that draws this factor from this range, the others as in training; may be repeated",
    )
    parser.add_argument("--worlds", type=int, metavar="N", help="worlds in each set")
    parser.add_argument("--engine", metavar="NAME", help="auto, mujoco or mjx; default: as in training")
    parser.add_argument(
        "--require",
        action="append",
        default=[],
        metavar="CONDITION",
        help="exit with 3 unless it holds, as in 'held_out.success>=0.9'; may be repeated",
    )
    parser.add_argument(
        "--against",
        type=Path,
        metavar="RUN",
        help="compare with this run (its last policy) on the same worlds, in the report",
    )
    parser.add_argument(
        "--best", action="store_true", help="the policy that did best in training instead of the last one"
    )
    parser.add_argument("--json", action="store_true", help="print transfer.json instead of a table")


def _evaluate(given: argparse.Namespace) -> int:
    from simreal import evaluating

    request = evaluating.Request.parse(
        *(given.run, given.sets, given.ranges, given.worlds, given.engine, given.require, given.against),
        best=given.best,
    )
    _set_up_jax()
    failures = evaluating.evaluate(request, as_json=given.json)
    for line in failures:
        print(f"simreal: {line}", file=sys.stderr)
    return REQUIREMENT_FAILED if failures else DONE


def _build_replay(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help="a file in RUN/quarantine")
    parser.add_argument("--engine", metavar="NAME", help="auto, mujoco or mjx; default: as in training")
    parser.add_argument("--out", type=Path, metavar="DIR", help="for the film; default: beside FILE")


def _replay(given: argparse.Namespace) -> int:
    _set_up_jax()
    from simreal import replaying

    replaying.show(given.file, given.engine, given.out, print)
    return DONE


def _build_sweep(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("sweep", nargs="?", metavar="SWEEP.yaml", help="what to sweep over")


def _sweep(given: argparse.Namespace) -> int:
    raise UserError("sweep: not in version 0.1; until then, call 'simreal train' once for each setting")


def _build_doctor(parser: argparse.ArgumentParser) -> None:
    pass


def _doctor(given: argparse.Namespace) -> int:
    _set_up_jax()
    from simreal import doctor

    doctor.examine(print)
    return DONE


def _set_up_jax() -> None:
    from simreal.compilation import enable_cache

    enable_cache()


Builder = Callable[[argparse.ArgumentParser], None]
COMMANDS: dict[str, tuple[str, Builder, Callable[[argparse.Namespace], int]]] = {
    "list": ("Show the environments and the shipped configurations.", _build_list, _list),
    "train": ("Train a policy.", _build_train, _train),
    "evaluate": ("Measure a policy on sets of worlds, and write its report.", _build_evaluate, _evaluate),
    "replay": ("Run a world that blew up in training again, and film it.", _build_replay, _replay),
    "sweep": ("Train over a grid of settings (not in this version).", _build_sweep, _sweep),
    "doctor": ("Show what this machine offers, and what is wrong with it.", _build_doctor, _doctor),
}

if __name__ == "__main__":
    sys.exit(main())
