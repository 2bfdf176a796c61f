"""Command line: help texts, error messages, exit codes, and no partial files."""

from __future__ import annotations

import inspect
import re
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from beliefscope.app.cli.main import COMMANDS, cli, command_group, main
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.diagnosis.catalog import CAUSES
from beliefscope.inspect.diagnosis.next_action import command_line

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
GOLDEN = Path(__file__).parent / "golden" / "errors.txt"
OPTIONS = {
    "demo": "--port --open --no-open",
    "serve": "--port --host --token --read-only --allow-host --workspace --task --data --filter --study --sweep "
    "--views --open --no-open --log-level --log-format --seed",
    "collect": "--episodes --steps --seed --workers -o --json",
    "convert": "--data --skip-bad -o --json",
    "train": "--filter --data --skip-bad --preset --faults --seed --log -o --json",
    "finetune": "--filter --train --freeze --slice --faults --clean-weight --event --data --skip-bad "
    "--steps --length --rate --l2-sp --patience --seed --log --rerun -o --json",
    "modules": "--filter --train --freeze --depth --json",
    "change": "--task --data --skip-bad --all --slice --particles --seed -o --json",
    "lineage": "--export -o --json",
    "evaluate": "--filter --data --skip-bad --faults --only --particles --seed --json",
    "calibrate": "--filter --data --skip-bad --faults --level --particles --seed -o --json",
    "study": "--preset --task --filter --seeds --data --skip-bad --engine --workers -o --json",
    "sweep": "--checkpoints --data --faults --seeds --particles --all --block --engine --workers -o --json",
    "experiments": "--phase --sort --top --sql -o --json",
    "trace": "--filter --data --skip-bad --episode --faults --seed --particles-kept -o --json",
    "record": "--filter --data --skip-bad --episode --maps --map-size --diagnostics --no-diagnostics --faults --seed "
    "-o --json",
    "live": "--filter --data --skip-bad --episode --faults --particles --seed --rate --workspace --name --json",
    "import": "--map --guess --episode -o --json",
    "export": "--filter --interactive -o --json",
    "inspect": "--filter --only --option --all --figures --format --json",
    "diagnose": "--filter --data --skip-bad --episode --base --alarm-rate --faults --particles --seed --json",
    "report": "-o --title --event --filter --data --all --url --pdf --json",
    "counterfactual": "--filter --data --episode --faults --weights --from --to --particles --seed --trace -o --json",
    "figure": "--filter --data --skip-bad --episode --step --map --chart --component --beta --window --seconds --group "
    "--faults --particles --seed -o --json",
    "failures": "--filter --data --skip-bad --faults --by --top --phase --all --url --engine --workers --particles "
    "--seed --json",
    "slices": "--filter --data --skip-bad --faults --by --alpha --all --particles --seed --json",
    "faults": "--json",
    "mcp": "--task --data --filter --url --particles --seed",
    "doctor": "--workspace --host --port --json",
}
"""Options that external scripts may rely on."""

Run = Callable[[str], tuple[int, str, str]]


def examples() -> list[str]:
    """Every command line in the help texts, the documentation and the next actions of diagnosed causes."""
    callbacks = [cli.registered_callback, *cli.registered_commands]
    text = "\n".join(inspect.getdoc(info.callback) or "" for info in callbacks if info is not None and info.callback)
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        if page.is_file():
            text += "\n" + "\n".join(re.findall(r"```(?:sh|bash)?\n(.*?)```", page.read_text(), re.DOTALL))
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    text += "".join(f"\n{command_line(cause.command, checkpoint)}" for cause in CAUSES if cause.command is not None)
    return list(dict.fromkeys(re.findall(r"^ *(beliefscope (?:-|[a-z]+).*?)(?:   .*| +#.*)?$", text, re.MULTILINE)))


@pytest.mark.parametrize("name", COMMANDS)
def test_help_lists_every_supported_option_and_an_example(run: Run, name: str) -> None:
    code, out, err = run(f"{name} --help")
    assert (code, err) == (0, "")
    missing = [option for option in OPTIONS[name].split() if not re.search(rf"(?<![\w-]){option}\b", out)]
    assert not missing
    assert f"beliefscope {name} " in out.split("Example", 1)[1]


def test_help_lists_the_commands(run: Run) -> None:
    assert run("") == run("--help") == run("-h")
    code, out, _ = run("")
    assert code == 0
    groups = out[out.index("Start:\n") :]
    names = [line.split()[0] for line in groups.splitlines() if line.startswith("  ")]
    assert names == list(COMMANDS)
    assert set(COMMANDS) == set(OPTIONS)
    assert "...\n" not in groups, "the first sentence of a command is truncated in the list"


@pytest.mark.parametrize("line", examples())
def test_examples_are_accepted(line: str) -> None:
    name, *arguments = shlex.split(line)[1:]
    if name.startswith("-"):
        return
    command = command_group().commands[name]
    command.make_context(name, arguments)


@pytest.mark.parametrize("line", examples())
def test_options_have_the_values_of_the_examples(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of ``Path`` and text, for which a callback may check the value but must return it."""
    monkeypatch.chdir(tmp_path)
    name, *words = shlex.split(line)[1:]
    if name.startswith("-"):
        return
    values = command_group().commands[name].make_context(name, words).params.values()
    texts = {str(v) for value in values for v in (value if isinstance(value, list | tuple) else [value])}
    options = [
        i for i, word in enumerate(words) if re.fullmatch(r"-o|--(log|data|filter|output|figures|workspace)", word)
    ]
    assert {words[i + 1] for i in options} <= texts


@pytest.mark.parametrize("name", ["train", "finetune"])
def test_the_folder_of_logs_is_passed_to_the_command(name: str, tmp_path: Path) -> None:
    words = ["door", "--filter", "crossmodal-ekf", "--log", str(tmp_path), "-o", str(tmp_path / "new.safetensors")]
    assert command_group().commands[name].make_context(name, words).params["log"] == tmp_path


def test_version(run: Run) -> None:
    assert re.fullmatch(r"beliefscope \d+\.\d+\.\d+\S*\n", run("--version")[1])


def test_help_imports_no_heavy_module() -> None:
    heavy = {"torch", "mujoco", "h5py", "rerun", "fastapi", "uvicorn", "viser", "numpy", "rich"}
    code = f"import sys, beliefscope.app.cli.main; print(*sorted(set(sys.modules) & {heavy}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.split() == []


@pytest.mark.parametrize("names", [("dor", "crossmodal-pf"), ("door", "crosmodal-pf"), ("push", "crossmodal-ukf")])
def test_wrong_names_are_reported_without_pytorch(names: tuple[str, str]) -> None:
    code = (
        "import sys\n"
        "from beliefscope.app.cli.options import Runs\n"
        "from beliefscope.datasets.errors import BadInput\n"
        f"try: Runs(*{names})\n"
        "except BadInput: print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout == "False\n"


EKF = "door --filter ekf.safetensors"
BAD = [
    "nosuch",
    "evaluate",
    "evaluate dor --filter crossmodal-pf",
    "evaluate door --filter crosmodal-pf",
    "evaluate door --filter missing.safetensors",
    "evaluate door --filter ./missing",
    "evaluate door --filter foreign.safetensors",
    "evaluate door --filter other.safetensors",
    "evaluate door --filter cut.safetensors",
    "evaluate door --filter shape.h5",
    f"evaluate {EKF} --data missing.h5",
    f"evaluate {EKF} --data taken",
    f"evaluate {EKF} --data foreign.h5",
    f"evaluate {EKF} --data other.h5",
    f"evaluate {EKF} --data cut.h5",
    f"evaluate {EKF} --data shape.h5",
    f"evaluate {EKF} --data ekf.safetensors",
    f"evaluate {EKF} --particles 0",
    f"evaluate {EKF} --seed -1",
    f"slices {EKF} --alpha 2",
    f"calibrate {EKF} --level 1 -o calibration.json",
    f"calibrate {EKF} -o calibration.pkl",
    f"slices {EKF} --by speed",
    f"evaluate {EKF} --json out.json",
    f"evaluate {EKF} --faults notes.txt",
    f"evaluate {EKF} --faults missing.json",
    f"evaluate {EKF} --faults {{no}}",
    f"""evaluate {EKF} --faults '{{"noise": 1}}'""",
    f"evaluate {EKF} --faults blackout=1.5",
    f"evaluate {EKF} --faults force_bias:w=5",
    f"evaluate {EKF} --faults drop=touch",
    f"evaluate {EKF} --only touch",
    f"trace {EKF} --faults blackout=0.4: -o new.trace",
    f"record {EKF} --faults frozen -o new.rrd",
    "train door --filter crossmodal-pf --faults blackout=much -o new.safetensors",
    "train door --filter crossmodal-pf --blackouts 0,1.5 -o new.safetensors",
    "inspect",
    "inspect missing.trace",
    "inspect ekf.safetensors",
    "inspect missing.trace --only health",
    "inspect missing.trace --format gif",
    "inspect missing.trace --option step",
    "inspect missing.trace --only saliency --option size=3",
    "inspect missing.trace --only saliency --option step=soon",
    "inspect missing.trace --figures notes.txt",
    "report",
    "report missing.trace",
    "report ekf.safetensors",
    "report missing.trace -o notes.txt",
    "report missing.trace -o missing/new",
    "report missing.trace --url here",
    "faults --json file",
    f"""evaluate {EKF} --faults '{{"blackout": "much"}}'""",
    f"""evaluate {EKF} --faults '{{"blackout": 1.5}}'""",
    "collect dor --episodes 1 -o new.h5",
    "collect door --episodes 0 -o new.h5",
    "collect door --episodes 1 --steps 1 -o new.h5",
    "collect door --episodes 1 -o missing/new.h5",
    "collect door --episodes 1 -o taken",
    "collect door --episodes 1 -o new.npz",
    "collect door --episodes many -o new.h5",
    "train door --filter crosmodal-pf -o new.safetensors",
    "train door --filter crossmodal-pf --preset fast -o new.safetensors",
    "train door --filter crossmodal-pf --data cut.h5 -o new.safetensors",
    "train door --filter crossmodal-pf -o missing/new.safetensors",
    "train door --filter crossmodal-pf",
    f"finetune {EKF} --train touch-only -o new.safetensors",
    f"finetune {EKF} --train dynamics-only --freeze dynamics -o new.safetensors",
    f"finetune {EKF} --slice dark -o new.safetensors",
    f"finetune {EKF} --clean-weight 2 -o new.safetensors",
    f"finetune {EKF} --event 9:30-20 -o new.safetensors",
    f"finetune {EKF} --rate fast -o new.safetensors",
    "finetune door -o new.safetensors",
    f"finetune {EKF} --rerun nowhere -o new.safetensors",
    f"finetune {EKF} --log new --rerun nowhere -o new.safetensors",
    "finetune missing.safetensors -o new.safetensors",
    f"modules {EKF} --freeze weigth_model",
    f"trace {EKF} --episode 100000 -o new.trace",
    f"trace {EKF} --episode -1 -o new.trace",
    f"trace {EKF} -o missing/new.trace",
    f"record {EKF} --maps -1 -o new.rrd",
    f"record {EKF} --data cut.h5 -o new.rrd",
    f"record {EKF} -o taken",
    f"record {EKF} -o new.mcap",
    f"trace {EKF} -o new.npz",
    "train door --filter crossmodal-pf -o new.pt",
    "train door --filter crossmodal-pf -o ekf.safetensors",
    "finetune ekf.safetensors -o ekf.safetensors",
    "finetune door --filter crossmodal-ekf -o new.pt",
    f"counterfactual {EKF} --from 40 --to 60",
    f"counterfactual {EKF} --faults blackout --from 60 --to 40",
    f"counterfactual {EKF} --faults blackout:from=45 --from 40 --to 60",
    f"counterfactual {EKF} --weights image --from 40 --to 60",
    f"counterfactual {EKF} --weights image=0.8,haptics=0.8 --from 40 --to 60",
    f"counterfactual {EKF} --weights image=1 --from 40 --to 60 -o new.gif",
    f"counterfactual {EKF} --weights image=1 --from 40 --to 60 --trace missing/new.trace",
    f"figure bars {EKF} -o new.svg",
    f"figure maps {EKF} -o new.gif",
    f"figure maps {EKF} -o taken",
    f"figure weights {EKF} --step 40 -o new.svg",
    f"figure weights {EKF} -o new.csv",
    f"figure weights {EKF} --window 20-60 -o new.svg",
    f"figure timeline {EKF} --map posterior -o new.svg",
    f"figure timeline {EKF} --window 20 -o new.svg",
    f"live {EKF} --rate -1",
    f"live {EKF} --name a/b",
    f"live {EKF} --workspace notes.txt",
    f"live {EKF} --workspace missing/deep",
    f"live {EKF} --episode 999",
    "import missing.rrd -o new.trace",
    "import notes.txt -o new.trace",
    "import notes.txt -o taken",
    "export missing.trace -o new.npz",
    "export missing.rrd -o new.npz",
    "export other.safetensors -o new.npz",
    "export missing.trace -o new.csv",
    "export missing.trace -o missing/new.parquet",
    "serve --port 70000",
    "serve --views 0",
    "serve --workspace notes.txt",
    "serve --workspace missing/deep",
    "serve --task dor",
    "serve --task missing.py:TASK",
    "serve --data missing.h5 --port 0",
    "serve --data other.h5 --data cut.h5 --port 0",
    "serve --filter other.safetensors --port 0",
    "serve --filter ./missing --port 0",
    "serve --study .",
    "serve --log-level loud",
    "serve --log-format xml",
    "doctor --port 70000",
    "mcp --url localhost:8000",
    "doctor --json file",
    "change crossmodal-ekf crossmodal-pf",
    "change crossmodal-ekf missing.safetensors",
    "change crossmodal-ekf ekf.safetensors --slice dark",
    "change crossmodal-ekf ekf.safetensors -o taken",
    "lineage nowhere",
    "lineage notes.txt",
    "lineage ekf.safetensors --export nothing -o copy",
    "lineage ekf.safetensors --export ekf.safetensors",
]


def contents(folder: Path) -> dict[Path, int]:
    """File -> modification time in ns."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("line", BAD)
def test_invalid_input_prints_one_line_and_exits_with_2(
    run: Run, files: Path, monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    monkeypatch.chdir(files)  # shared by all lines, because none may write
    before = contents(files)
    code, out, err = run(line)
    assert (code, out) == (2, "")
    assert re.fullmatch(r"error: .+\n", err)
    assert contents(files) == before, "partial files remain"
    assert err.strip() == golden().get(line, err.strip())


def golden() -> dict[str, str]:
    """Command line -> error message, for messages that do not depend on library versions."""
    return dict(re.findall(r"^\$ beliefscope (.*)\n(error: .*)$", GOLDEN.read_text(), re.MULTILINE))


def test_every_golden_error_is_tested() -> None:
    assert golden()
    assert not golden().keys() - set(BAD)


def test_busy_port(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        code, out, err = run(f"serve --port {port}")
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert f"port {port}" in err
    assert "--port" in err
    assert not (tmp_path / "workspace").exists()


@pytest.mark.parametrize(
    ("number", "line", "code"),
    [
        (signal.SIGINT, "error: interrupted; the same command resumes", 130),
        (signal.SIGTERM, "error: terminated; the same command resumes", 143),
    ],
    ids=["SIGINT", "SIGTERM"],
)
def test_a_signal_prints_one_line_and_exits_with_the_code_of_the_shell(
    number: signal.Signals, line: str, code: int, tmp_path: Path
) -> None:
    program = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from beliefscope.app.cli.main import main; main()"
    )
    command = f"collect push --episodes 40 --steps 50 -o {tmp_path / 'push.h5'}".split()
    with subprocess.Popen([sys.executable, "-c", program, *command], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline().count("%") == 1, "the first line of the progress"
        process.send_signal(number)
        try:
            *_, last = process.communicate(timeout=60.0)[1].splitlines()
        finally:
            process.kill()
    assert (last, process.returncode) == (line, code)


def test_ctrl_c_during_the_imports_prints_one_line() -> None:
    program = """
import sys
class Interrupt:
    def find_spec(self, name, *_):
        if name == "typer":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupt())
from beliefscope.__main__ import main
main()
"""
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (process.returncode, process.stdout, process.stderr) == (130, "", "error: interrupted\n")


def test_unexpected_errors_exit_with_1_and_a_traceback_on_request(
    run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("the network is full of eels")

    monkeypatch.setattr("beliefscope.filters.evaluate.evaluate", fail)
    code, out, err = run(f"evaluate {EKF}")
    assert (code, out) == (1, "")
    assert err.splitlines()[-1].startswith("error: RuntimeError: the network is full of eels")
    assert "Traceback" not in err
    monkeypatch.setattr(sys, "argv", ["beliefscope", "--debug", "evaluate", *EKF.split()])
    with pytest.raises(RuntimeError, match="eels"):
        main()
