"""The guides of deploying: their blocks run in a sandbox as they are printed (sandbox.py).

An `ini` block is written to the file that its first line names. What a sandbox cannot do has a
stand-in: NFS, systemd and ssh between machines.
"""

import re
from pathlib import Path

import pytest
from sandbox import run, sandbox

ROOT = Path(__file__).parents[1]

__all__ = ["sandbox"]

FEW = """kind: rod_hang
name: demo-rods
axes: {gamma: [300, 900], phi0: 0.2, phi1: [6, 12]}
quality: draft
"""
"""Four rods in place of the 48 of the demo."""


def script_of(page: str) -> str:
    """Return the shell and the files of a page as one script."""
    lines: list[str] = []
    blocks = re.findall(
        r"^```(sh|ini)\n(.*?)^```$", (ROOT / "docs" / page).read_text(), re.M | re.S
    )
    for language, code in blocks:
        if language == "sh":
            lines.append(code)
            continue
        path = re.match(r"# (/\S+)\n", code)
        assert path is not None, code
        lines.append(f"cat > {path[1]} <<'END'\n{code}END\n")
    return "\n".join(lines)


@pytest.mark.real
@pytest.mark.timeout(1200)
def test_the_guide_of_a_lab_runs_from_its_first_line(sandbox: Path) -> None:
    """User, share, units, TLS, key, worker and a dataset; then the worker stops in order."""
    script = script_of("deploy-systemd.md")
    # The demo has 48 rods: four show the same.
    script = script.replace("--max-cpus 16", "--max-cpus 2").replace(
        "examples/demo-rods.yaml", "/home/me/few.yaml"
    )
    check = f"""
cat > /home/me/few.yaml <<'END'
{FEW}END
{script}
test "$(stat -c %U:%a /var/lib/stickslip)" = stickslip:700
test "$(stat -c %U /var/lib/stickslip/shared/store)" = stickslip
stickslip verify my-rods
mountpoint -q /var/lib/stickslip/shared
systemctl stop stickslip-worker
"""
    done = run(check, sandbox)
    assert done.returncode == 0, (done.stdout + done.stderr)[-6000:]


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_guide_of_a_ray_cluster_runs(sandbox: Path) -> None:
    """A head, a node and a dispatcher with a token, on one machine with the address of the guide.

    A directory stands in for the bucket, and one coordinator for two.
    """
    code = script_of("your-ray.md")
    for printed, used in {
        "s3://lab/stickslip": "/home/me/data/store",
        "--url https://a.example.org --url https://b.example.org": "--url http://127.0.0.1:8765",
        "--key-file worker-key": "--key-file /home/me/data/worker-key &",
    }.items():
        assert printed in code
        code = code.replace(printed, used)
    script = f"""
cat > /home/me/few.yaml <<'END'
{FEW}END
ip link add lab0 type veth peer name lab1
ip address add 10.0.0.5/24 dev lab0
ip link set lab1 up
ip link set lab0 up
ip route add default dev lab0
python -m stickslip_services.app --data /home/me/data &
until stickslip jobs > /dev/null 2>&1; do sleep 0.5; done
{code}
test "$(stat -c %a /srv/ray-token)" = 600
stickslip submit /home/me/few.yaml --watch
stickslip pull demo-rods /home/me/my-rods
stickslip verify /home/me/my-rods
"""
    done = run(script, sandbox)
    assert done.returncode == 0, (done.stdout + done.stderr)[-6000:]


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_guide_of_containers_runs_without_docker(sandbox: Path) -> None:
    """Each service starts as compose.yaml and its Dockerfile say, is healthy, and makes a dataset.

    Not tried: building of images, MinIO, limits of memory and cores, rotation of logs, restarts.
    """
    code = script_of("deploy-containers.md")
    build = next(b for b in code.split("\n\n") if "docker compose build" in b)
    submit = next(b for b in code.split("\n\n") if "stickslip submit" in b)
    submit = submit.replace("../../examples/demo-rods.yaml", "/home/me/few.yaml")
    script = f"""
cat > /home/me/few.yaml <<'END'
{FEW}END
cp -r /opt/stickslip/deploy /home/me
cd /home/me
{build}
export STICKSLIP_URL=http://coordinator:8765
{submit}
stickslip verify my-rods
docker compose exec --no-TTY worker sh -c 'test ! -w / && test ! -w /data && touch /tmp/file'
docker compose exec --no-TTY coordinator sh -c 'test ! -w / && touch /data/file'
docker compose ps
docker compose down
"""
    done = run(script, sandbox)
    assert done.returncode == 0, (done.stdout + done.stderr)[-6000:]
    lines = done.stdout.splitlines()
    names = ("coordinator-1", "worker-1", "worker-2")
    # Twice: the guide asks, and the end of this test does.
    assert [lines.count(f"{name} running") for name in names] == [2, 2, 2], done.stdout
    # What we start ends on SIGTERM within its grace, also as the first process of a container.
    assert [lines.count(f"{name}: ended") for name in names] == [1, 1, 1], done.stdout
