"""What lies beside an export for machines: Croissant's description and BOP's tar shards."""

import hashlib
import json
import tarfile

import numpy as np
import pytest

from labelled_scenes import labelled_scene
from realsim import images
from realsim.formats.bop.labels import mask_of
from realsim.formats.bop.root_files import write_bop_models, write_bop_root
from realsim.formats.bop.writing import BopWriteConfig, write_bop_scene
from realsim.formats.export_folder import ExportFolder
from typed_commands import finished


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    home = tmp_path_factory.mktemp("release")
    scene = labelled_scene(home / "images", [0, 7])
    folder = ExportFolder.begin(home / "source", {})
    write_bop_scene(scene, folder, BopWriteConfig())
    write_bop_models(scene.models(), folder)
    write_bop_root(folder, name="three boxes")
    folder.finish({})
    to = ("--to", "bop", "--shards", "--out", home / "out")
    finished("export", home / "source", *to, "--quiet")
    return home / "out"


def test_shards_hold_every_image_with_its_rows_and_masks(release):
    keys = json.loads((release / "train_web/key_to_shard.json").read_text())
    assert keys == {"000003_000000": 0, "000003_000007": 0}
    scene = release / "train/000003"
    with tarfile.open(release / "train_web/shard-000000.tar") as tar:
        held = {m.name: tar.extractfile(m).read() for m in tar.getmembers()}
    endings = ("rgb.png", "depth.png", "camera.json", "gt.json", "gt_info.json", "mask.json",
               "mask_visib.json")  # fmt: skip
    assert set(held) == {f"{key}.{ending}" for key in keys for ending in endings}
    assert held["000003_000007.rgb.png"] == (scene / "rgb/000007.png").read_bytes()
    for name in ("camera", "gt", "gt_info"):
        rows = json.loads((scene / f"scene_{name}.json").read_text())
        assert json.loads(held[f"000003_000007.{name}.json"]) == rows["7"]
    for kind in ("mask", "mask_visib"):
        masks = json.loads(held[f"000003_000007.{kind}.json"])
        for k in range(3):
            file = scene / kind / f"000007_{k:06d}.png"
            assert np.array_equal(mask_of(masks[str(k)]), images.read_grey(file) > 0)


def test_the_description_names_files_with_their_checksums_and_sets_that_find_them(release):
    document = json.loads((release / "croissant.json").read_text())
    assert document["conformsTo"] == "http://mlcommons.org/croissant/1.0"
    found = set()
    for part in document["distribution"]:
        if part["@type"] == "cr:FileObject":
            data = (release / part["contentUrl"]).read_bytes()
            assert hashlib.sha256(data).hexdigest() == part["sha256"]
            found.add(part["contentUrl"])
        else:
            files = {p.relative_to(release).as_posix() for p in release.glob(part["includes"])}
            assert part["description"] == f"{len(files)} files"
            found |= files
    sums = {x.split("  ")[1] for x in (release / "SHA256SUMS").read_text().splitlines()}
    assert sums - found <= {"README.md", "croissant.json", "provenance.json"}
    (records,) = document["recordSet"]
    assert [f["name"] for f in records["field"]] == ["path", "image"]
