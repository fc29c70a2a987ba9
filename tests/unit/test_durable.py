"""Files that are replaced whole."""

import stat

from ldcnd import durable


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
