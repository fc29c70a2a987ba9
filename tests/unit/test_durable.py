"""Files that are replaced whole."""

import stat

import pytest

from ldcnd import durable
from tests.support.small_disk import fill, small_disk


def test_a_replaced_file_keeps_who_may_read_it_and_the_link_to_it(tmp_path):
    file, link = tmp_path / "rig-2026.toml", tmp_path / "rig.toml"
    file.write_text("old")
    file.chmod(0o640)
    link.symlink_to(file)

    durable.replace(link, "new")

    assert link.is_symlink()
    assert file.read_text() == "new"
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    assert sorted(tmp_path.iterdir()) == [file, link]


def test_a_new_file_is_made_with_its_folder(tmp_path):
    file = tmp_path / "state" / "x.json"

    durable.replace(file, "new")

    assert file.read_text() == "new"


def test_a_full_disk_takes_text_after_text_of_a_file_that_room_was_kept_for(tmp_path):
    with small_disk(tmp_path / "disk", 128 * 1024) as disk:
        file = disk / "latches.json"
        durable.keep_room(file, 16 * 1024)
        fill(disk)
        texts = [f"{at} " * 2000 for at in range(5)]
        read = []
        for text in texts:
            durable.replace(file, text)
            durable.keep_room(file, 16 * 1024)
            read.append(file.read_text())
        with pytest.raises(OSError, match="No space"):
            durable.replace(disk / "other.json", "new")

        assert read == texts
        assert not (disk / "other.json.new").exists()
