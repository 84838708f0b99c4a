"""A reader who runs the documentation's blocks: a process that has everything imported, and forks.

A `restock` command takes seconds to start and often less to run. So one server imports it all once;
a page of blocks is run by a fork of it, and so is every command of a shell block: the `restock` on
the shell's PATH is a client that hands its arguments, folder, environment and streams over.

What would take minutes is cut short where it begins (`cut_short`), whatever the command or the
call says: a training is some hundred steps, an evaluation one episode a kind. Everything else is
as printed.

    python -m support.reader FOLDER    serves at FOLDER/socket
"""

import dataclasses
import gc
import json
import os
import signal
import socket
import stat
import subprocess
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from support.pages import SHELL, Block
from support.paths import ROOT

NODE = """#!/bin/sh
exec {python} -c 'import sys; from restock.cli import run_node; sys.exit(run_node())' "$@"
"""
CLIENT = """#!{python} -IS
import json, os, socket, sys
with socket.socket(socket.AF_UNIX) as client:
    client.connect({address!r})
    asked = {{"argv": sys.argv[1:], "folder": os.getcwd(), "environment": dict(os.environ)}}
    socket.send_fds(client, [json.dumps(asked).encode()], [0, 1, 2])
    client.shutdown(socket.SHUT_WR)
    sys.exit(int(client.recv(16) or b"70"))
"""
# Ends a block at the first command that fails, but for those that may end with one of the codes.
TRAP = """trap 'code=$?; case " {codes} " in *" $code "*) ;; *) exit $code ;; esac' ERR\n"""
SHORT = {
    "schedule": {"env_steps": 64, "offline_updates": 16, "warmup_env_steps": 32},
    "env": {"num_envs": 4},
    "teacher": {"offline_updates": 16},
    "evaluation": {"every_env_steps": 64, "episodes": 1},
    "record": {"every_updates": 8, "checkpoint_every_env_steps": 32, "audit_share": 1.0},
}


@contextmanager
def reader(folder: Path) -> Iterator["Reader"]:
    """Yield a server for as long as the context lasts; its socket and client lie in `folder`."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, [ROOT / "tests", *sys.path])),
    }
    command = [sys.executable, "-m", "support.reader", str(folder)]
    server = subprocess.Popen(command, env=environment, start_new_session=True)
    try:
        while not (folder / "restock").exists():
            assert server.poll() is None, "the server did not start"
            time.sleep(0.05)
        yield Reader(folder)
    finally:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait()


class Reader:
    """The test's side of the server."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def run(self, blocks: list[Block], where: Path) -> str:
        """Run a page's blocks in a folder: "", or what went wrong, with the place."""
        requested = {
            "blocks": [
                [b.place, b.language, b.shell, b.exit_codes, b.marks.get("before", "")]
                for b in blocks
            ],
            "folder": str(where),
            "environment": {**os.environ, "PATH": f"{self.folder}:{os.environ['PATH']}"},
        }
        with socket.socket(socket.AF_UNIX) as client, (where / ".log").open("w+") as log:
            client.connect(str(self.folder / "socket"))
            socket.send_fds(
                client, [json.dumps(requested).encode()], [0, log.fileno(), log.fileno()]
            )
            client.shutdown(socket.SHUT_WR)
            code = client.recv(16)
            log.seek(0)
            return "" if code == b"0" else log.read()[-4000:] or f"died: {code!r}"


def serve(folder: Path) -> None:
    """Import everything, then run what is asked for, each in a fork."""
    import_all()
    cut_short()
    script_once()
    gc.collect()
    gc.freeze()  # a fork's collections leave the pages that it shares alone
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(folder / "socket"))
    listener.listen()
    client = folder / "restock.new"
    client.write_text(CLIENT.format(python=sys.executable, address=str(folder / "socket")))
    client.chmod(client.stat().st_mode | stat.S_IXUSR)
    for installer in ("pip", "make"):  # never by a test
        (folder / installer).write_text(
            "#!/bin/sh\necho 'mark this block as not run' >&2; exit 70\n"
        )
        (folder / installer).chmod(0o755)
    (folder / "python").write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    (folder / "python").chmod(0o755)
    (folder / "restock-node").write_text(NODE.format(python=sys.executable))
    (folder / "restock-node").chmod(0o755)
    client.rename(folder / "restock")
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    listener.settimeout(1)
    parent = os.getppid()
    while os.getppid() == parent:  # a test process that was killed ends no server
        try:
            connection, _ = listener.accept()
        except TimeoutError:
            continue
        connection.setblocking(True)
        if os.fork():
            connection.close()
            continue
        listener.close()
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        _answer(connection)


def _answer(connection: socket.socket) -> None:
    """In the fork: take over the asker's streams, folder and environment, and end with its code."""
    code = 70
    try:
        received, descriptors, _, _ = socket.recv_fds(connection, 1 << 20, 3)
        while more := connection.recv(1 << 20):
            received += more
        requested = json.loads(received)
        for number, descriptor in enumerate(descriptors):
            os.dup2(descriptor, number)
        os.chdir(requested["folder"])
        os.environ.clear()
        os.environ.update(requested["environment"])
        code = _command(requested["argv"]) if "argv" in requested else _page(requested["blocks"])
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:  # noqa: BLE001  (a fork must never return into the server's loop)
        traceback.print_exc()
        sys.stderr.flush()
    connection.send(str(code).encode())
    os._exit(0)


def _command(argv: list[str]) -> int:
    from restock.cli import main

    return main(argv)


def _page(blocks: list[tuple[str, str, str, list[int], str]]) -> int:
    """Run a page's blocks in order; the Python ones share their names, as in a notebook."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for place, language, text, codes, before in blocks:
        began = time.perf_counter()
        try:
            if before:
                subprocess.run(["bash", "-ec", before], check=True, stdout=subprocess.DEVNULL)
            if language in SHELL:
                script = TRAP.format(codes=" ".join(map(str, codes))) + text
                done = subprocess.run(["bash", "-c", script], check=False)
                if done.returncode not in codes:
                    raise RuntimeError(f"exit code {done.returncode}")
            elif language == "sql":
                _sql(text)
            else:
                page, line = place.split(":")
                exec(compile("\n" * (int(line) - 1) + text, page, "exec"), names)
        except BaseException:  # noqa: BLE001  (whatever it raises is the finding)
            traceback.print_exc()
            sys.stderr.write(f"{place}: this {language} block failed:\n{text}")
            return 1
        sys.stderr.write(f"== {place} took {time.perf_counter() - began:.1f} s\n")
        sys.stderr.flush()
    return 0


def _sql(text: str) -> None:
    """Run a block of SQL on the store."""
    import restock

    with restock.open("store/") as store:
        store.sql(text).fetchall()


def import_all() -> None:
    """Everything that a command or a block imports."""
    import importlib
    import pkgutil

    import restock

    for module in pkgutil.walk_packages(restock.__path__, "restock."):
        if not module.name.endswith("__main__"):
            try:
                importlib.import_module(module.name)
            except ImportError as error:
                if "restock" in str(error.name):  # not an extra that is not installed
                    raise


def cut_short() -> None:
    """Make what takes minutes take a second; nothing else is changed."""
    import msgspec

    from restock.replay.fleet import forecast
    from restock.train import prepare
    from restock.train.evaluation import eval_run, ope, policies
    from restock.train.judge import fed_rows
    from restock.train.study import study_run
    from restock.train.twin.calibration import fit, gap
    from restock.train.twin.env import vector_env
    from restock.train.twin.recording.recorder import MissionsFile, RecordingPlan

    cut_libraries_short()
    resolve, plan, ended = (
        prepare.resolve_config,
        eval_run.plan_evaluation,
        RecordingPlan.__post_init__,
    )
    fit_all, measure = fit.fit, gap.measure_gap
    study, make = study_run.run_study, vector_env.WarehouseVectorEnv

    def short_config(config: Any, panel: Any) -> Any:
        parts = {
            name: msgspec.structs.replace(getattr(config, name), **values)
            for name, values in SHORT.items()
        }
        if not config.env.twin:  # it drives nothing
            parts["schedule"] = msgspec.structs.replace(parts["schedule"], env_steps=0)
        return resolve(msgspec.structs.replace(config, **parts), panel)

    def one_episode(*args: Any, **options: Any) -> Any:
        return plan(*args, **{**options, "episodes": 1})

    def few_missions(self: RecordingPlan) -> None:
        ended(self)
        missions: Any = 5 if (self.minutes or 0) > 5 else 2
        if isinstance(self.missions, MissionsFile):
            orders = [
                msgspec.structs.replace(order, missions=1) for order in self.missions.missions
            ]
            missions = msgspec.structs.replace(self.missions, missions=orders)
        object.__setattr__(self, "missions", missions)
        object.__setattr__(self, "minutes", None)

    def short_fit(store: Any, config: Any = None, **options: Any) -> Any:
        config = dataclasses.replace(
            config or fit.FitConfig(), search_points=0, max_segments=4, parameters=("gain",)
        )
        return fit_all(store, config, **options)

    def short_gap(store: Any, calibrated: Any = None, config: Any = None, **options: Any) -> Any:
        config = dataclasses.replace(config or gap.GapConfig(), max_segments=4)
        return measure(store, calibrated, config, **options)

    def short_episodes(*args: Any, **options: Any) -> Any:
        env = make(*args, **options)
        env.task = msgspec.structs.replace(env.task, time_limit_steps=12)
        return env

    def one_process(*args: Any, **options: Any) -> Any:
        return study(*args, **{**options, "workers": 1})

    def cut_short_verb(arguments: Sequence[str], log: Path) -> None:
        """In a fork of the server: a process of its own would not be cut short."""
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a") as file:
            done = subprocess.run(["restock", *arguments], stdout=file, stderr=file, check=False)
        assert done.returncode in (0, 3), log.read_text()

    forecast.REPLICATES = forecast.forecast.__kwdefaults__["replicates"] = 20
    policies.UPDATES = (0, 20)
    fed_rows.drive_twin.__kwdefaults__["steps"] = 60
    prepare.resolve_config = short_config
    vector_env.WarehouseVectorEnv = short_episodes  # what is recorded drives whole missions
    study_run.run_study = one_process
    study_run.restock_verb = cut_short_verb
    model = ope.OpeConfig().model
    object.__setattr__(model, "iterations", 2)
    object.__setattr__(model, "cloning_updates", 20)
    eval_run.plan_evaluation = eval_run.plan_evaluation = one_episode
    RecordingPlan.__post_init__ = few_missions
    fit.fit = short_fit
    gap.measure_gap = short_gap


def script_once() -> None:
    """Have the script of a page's charts made by a process of its own, once for all forks.

    It takes seconds, and the threads that make it do not survive a fork.
    """
    from restock.report.look import write

    code = "from restock.report.look.write import _runtime; print(_runtime(), end='')"
    made = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    script = made.stdout.decode()
    write._runtime = lambda: script
    write._packed()


def cut_libraries_short() -> None:
    """Cut the loop of Stable-Baselines3 short, and one of a page that calls its updates."""
    from stable_baselines3 import DQN

    learn, update = DQN.learn, DQN.train
    updates = Counter[int]()

    def short_learn(self: DQN, total_timesteps: int, *args: Any, **options: Any) -> Any:
        return learn(self, min(total_timesteps, 32), *args, **options)

    def short_update(self: DQN, gradient_steps: int, batch_size: int = 100) -> None:
        left = 64 - updates[id(self)]
        if left > 0:
            updates[id(self)] += min(gradient_steps, 16, left)
            update(self, min(gradient_steps, 16, left), batch_size)

    DQN.learn = short_learn
    DQN.train = short_update


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
