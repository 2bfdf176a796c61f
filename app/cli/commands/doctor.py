from pathlib import Path

from beliefscope.app.cli import console, options as opt


def doctor(
    workspace: Path = opt.option("DIR", "Workspace folder of the server.", Path("workspace")),
    host: str = opt.option("ADDRESS", "Address the server would listen on.", "127.0.0.1"),
    port: int = opt.option("N", "Port the server would listen on.", 8000, parser=opt.integer(0, 65535)),
) -> console.Result:
    """Check the installation and suggest fixes.

    Checks packages and their versions, PyTorch, the simulation and its camera, hashes of the pretrained filters and
    data, files of the dashboard, the port, the workspace and free disk space. Exits with 1 if a required check fails.
    The JSON output is meant for bug reports and contains no user names.

    \b
    Examples:
      beliefscope doctor
      beliefscope doctor --workspace runs --port 9000
      beliefscope doctor --json -
    """
    from beliefscope.app.cli.checks import Place, report, run_checks

    findings = run_checks(Place(workspace, host, port))
    lines = []
    for name, finding in findings.items():
        lines.append(f"{finding.state:<8}{name:<11}{finding.message}")
        lines += [f"{'':<19}-> {finding.advice}"] if finding.advice else []
    failed = sum(finding.state == "failed" for finding in findings.values())
    lines += ["", f"{failed} of {len(findings)} checks failed" if failed else "All required checks passed."]
    return console.Result(report(findings), "\n".join(lines), code=min(1, failed))
