"""Parts of a dataset are pulled, checked and completed; exports are started."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from stickslip_schemas.format.selection import SELECTION_NAME, Selection
from stickslip_services.app import make_app
from stickslip_services.cli import app
from stickslip_services.client.errors import ForeignFilesError, SelectionError
from stickslip_services.client.http import Client
from stickslip_services.client.pulling import pull
from stickslip_services.client.verifying import verify
from stickslip_services.settings import Settings
from stickslip_testing.jobs import rods
from stickslip_testing.servers import serving
from stickslip_testing.worker import DirectApi, PretendWorker

GAMMAS = (1.0, 2.0, 3.0, 4.0)


@pytest.fixture(scope="module")
def origin(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str, str]]:
    """URL and two datasets of a coordinator.

    Of the first, slot n of 0 to 7 has gamma n, two slots to a shard.
    """
    app = make_app(Settings(data=tmp_path_factory.mktemp("origin"), durable=False))
    with serving(app) as url, Client(url) as client:
        worker = PretendWorker(
            DirectApi(app.state.context), app.state.context.store, whole=True
        ).register()
        ids = []
        for gamma in (GAMMAS, GAMMAS[:2]):
            job = client.submit(rods(gamma=gamma, name=f"{len(gamma)}-rods"))
            worker.work()
            reference = client.job(job.id).dataset
            assert reference is not None
            ids.append(reference.dataset)
        yield url, ids[0], ids[1]


def files(target: Path) -> set[str]:
    return {path.relative_to(target).as_posix() for path in target.rglob("*") if path.is_file()}


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)))


def test_a_part_has_all_labels_and_the_shards_of_chosen_samples(
    origin: tuple[str, str, str], tmp_path: Path
) -> None:
    url, dataset, _ = origin
    target = tmp_path / "d"
    done = run(
        "pull",
        dataset,
        target,
        "--url",
        url,
        "--arrays",
        "views",
        "--where",
        "gamma<3",
        "--where",
        "gamma>=1",
    )
    assert done.exit_code == 0, done.output
    views = {path for path in files(target) if path.startswith("views/c/")}
    assert views == {f"views/c/{shard}/0/0/0/0" for shard in (0, 1)}  # slots 1 and 2
    assert not [path for path in files(target) if path.startswith(("centerline/", "frame/"))]
    assert "gamma/c/0" in files(target)
    part = json.loads((target / SELECTION_NAME).read_bytes())
    assert part["selection"] == {
        "arrays": ["views"],
        "split": None,
        "where": ["gamma<3", "gamma>=1"],
    }
    assert run("verify", target).exit_code == 0


def test_a_part_that_is_not_whole_is_found_and_mended(
    origin: tuple[str, str, str], tmp_path: Path
) -> None:
    url, dataset, _ = origin
    chosen = Selection(arrays=("views",), where=("gamma<2",))
    with Client(url) as client:
        pull(client, dataset, 1, tmp_path, selection=chosen)
        (tmp_path / "views/c/0/0/0/0/0").unlink()
        (tmp_path / "gamma/c/0").write_bytes(b"damaged")
        # Without labels nobody knows what else belongs to the part.
        assert [(fault.path, fault.fault) for fault in verify(tmp_path)] == [("gamma/c/0", "size")]
        pull(client, dataset, 1, tmp_path, selection=chosen)
        assert verify(tmp_path) == []
        (tmp_path / "views/c/0/0/0/0/0").unlink()
        assert [(fault.path, fault.fault) for fault in verify(tmp_path)] == [
            ("views/c/0/0/0/0/0", "missing")
        ]
        (tmp_path / SELECTION_NAME).write_text("{}")
        assert [(fault.path, fault.fault) for fault in verify(tmp_path)] == [
            (SELECTION_NAME, "selection")
        ]


def test_a_part_is_completed_and_not_mixed_with_another(
    origin: tuple[str, str, str], tmp_path: Path
) -> None:
    url, dataset, _ = origin
    with Client(url) as client:
        part = pull(client, dataset, 1, tmp_path, selection=Selection(arrays=()))
        with pytest.raises(ForeignFilesError, match="holds another part"):
            pull(client, dataset, 1, tmp_path, selection=Selection(arrays=("views",)))
        rest = pull(client, dataset, 1, tmp_path)
        assert not (tmp_path / SELECTION_NAME).exists()
        assert verify(tmp_path) == []
        assert part.downloaded_files + rest.downloaded_files == rest.files
        with pytest.raises(SelectionError, match="got 'movie'"):
            pull(client, dataset, 1, tmp_path / "new", selection=Selection(arrays=("movie",)))
        assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--split", "all"), "split: Input should be 'train', 'validation' or 'test'"),
        (("--where", "gamma"), "where must be a label, one of"),
        (("--where", "speed<3"), "where must name one of the labels"),
        (("--where", "gamma==9"), "no sample has gamma 9: the nearest values are 2, 3, 4;"),
        (("--where", "gamma>9"), "no valid sample is in this part of the dataset: gamma>9"),
    ],
)
def test_what_makes_no_sense_is_refused(
    origin: tuple[str, str, str], tmp_path: Path, options: tuple[str, str], message: str
) -> None:
    done = run("pull", origin[1], tmp_path / "d", "--url", origin[0], *options)
    assert (done.exit_code, message in " ".join(done.stderr.split())) == (1, True), done.output


def test_an_export_is_the_training_packages_work(
    origin: tuple[str, str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    url, dataset, _ = origin
    done = run(
        "export", dataset, "--webdataset", tmp_path / "out", "--obj", tmp_path / "b", "--url", url
    )
    assert done.exit_code == 1
    assert "an export needs one of" in capfd.readouterr().err
    monkeypatch.setattr("stickslip_services.cli.passed_on.find_spec", lambda _name: None)
    done = run("export", dataset, "--webdataset", tmp_path / "out", "--url", url)
    assert (done.exit_code, "pip install ./schemas './training[export]'" in done.stderr) == (
        1,
        True,
    )
