"""The container file, the compose file and what they mount, as far as they can be checked without an engine."""

import re
import shlex

import pytest
import yaml

from tests.support.pages import require_command_line
from tests.support.process import ROOT

CONTAINER = ROOT / "deploy" / "container"
LINES = (CONTAINER / "Dockerfile").read_text().replace("\\\n", " ").splitlines()
STEPS = [line.split(maxsplit=1) for line in LINES if line and not line.startswith("#")]
COMPOSE = yaml.safe_load((CONTAINER / "compose.yaml").read_text())
SERVICES = COMPOSE["services"]
OURS = [name for name, service in SERVICES.items() if service["image"] == "ldcnd"]


def of(step: str) -> list[str]:
    return [argument for name, argument in STEPS if name == step]


def test_the_image_is_debian_and_its_program_is_no_root():
    assert of("ARG")[0].startswith("BASE=debian:")
    assert of("FROM") == ["${BASE} AS build", "${BASE}"]
    assert of("USER") == ["ldcnd"]
    assert STEPS.index(["USER", "ldcnd"]) > max(at for at, (name, _) in enumerate(STEPS) if name == "RUN")


def test_what_the_image_copies_is_in_a_checkout():
    for argument in of("COPY"):
        if not argument.startswith("--from"):
            *sources, _ = argument.split()
            assert all((ROOT / source).exists() for source in sources), argument


def test_what_the_image_runs_are_commands_of_ldcnd():
    (entry,) = of("ENTRYPOINT")
    (command,) = of("CMD")
    (health,) = of("HEALTHCHECK")

    assert yaml.safe_load(entry) == ["ldcnd"]
    require_command_line(yaml.safe_load(command))
    require_command_line(yaml.safe_load(health.partition("CMD ")[2])[1:])


def test_packages_are_fetched_and_their_lists_removed_in_one_step():
    for step in of("RUN"):
        assert ("apt-get update" in step) == ("rm -rf /var/lib/apt/lists" in step)
        assert shlex.split(step)


@pytest.mark.parametrize("name", SERVICES)
def test_services_have_no_privileges_and_no_address_beyond_this_machine(name: str):
    service = SERVICES[name]

    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["network_mode"] == "host"
    assert "0.0.0.0" not in str(service)  # noqa: S104 - that it is not there
    assert not {"privileged", "ports"} & set(service)


@pytest.mark.parametrize("name", OURS)
def test_commands_of_services_can_be_typed(name: str):
    require_command_line([str(word) for word in SERVICES[name]["command"]])


@pytest.mark.parametrize("name", SERVICES)
def test_what_services_mount_exists_or_is_a_volume(name: str):
    for mount in SERVICES[name].get("volumes", []):
        source = mount.partition(":")[0]
        assert (CONTAINER / source).exists() if source.startswith(".") else source in COMPOSE["volumes"], mount


def test_a_rig_of_ones_own_gets_its_file_and_a_place_that_outlives_the_container():
    own = re.sub(r"(?m)^    # (\w+: \[)", r"    \1", (CONTAINER / "compose.yaml").read_text())
    mounted = dict(mount.split(":")[:2] for mount in yaml.safe_load(own)["services"]["rig"]["volumes"])

    assert mounted["./rig.toml"] in SERVICES["rig"]["command"]
    assert "state" in COMPOSE["volumes"]
    assert any(mounted["state"] in step.split() and "--owner ldcnd" in step for step in of("RUN"))


def test_everything_but_the_rig_waits_until_it_is_healthy():
    waiting = {name for name in OURS if "rig" in SERVICES[name].get("depends_on", {})}

    assert waiting == set(OURS) - {"rig"}


def test_prometheus_and_grafana_find_what_they_are_given():
    prometheus = yaml.safe_load((CONTAINER / "prometheus.yml").read_text())
    mounted = {mount.split(":")[1] for name in ("prometheus", "grafana") for mount in SERVICES[name]["volumes"]}
    provided = yaml.safe_load((CONTAINER / "grafana/provisioning/dashboards/ldcnd.yml").read_text())
    sources = yaml.safe_load((CONTAINER / "grafana/provisioning/datasources/prometheus.yml").read_text())

    assert set(prometheus["rule_files"]) <= mounted
    assert any(place.startswith(provided["providers"][0]["options"]["path"]) for place in mounted)
    assert prometheus["scrape_configs"][0]["static_configs"][0]["targets"] == ["127.0.0.1:9464"]
    assert sources["datasources"][0]["url"] == "http://127.0.0.1:9090"
    assert "--storage.tsdb.path=/prometheus" in SERVICES["prometheus"]["command"]
    assert "prometheus:/prometheus" in SERVICES["prometheus"]["volumes"]
    assert re.search(r"listen-address=127\.0\.0\.1:9090", str(SERVICES["prometheus"]["command"]))


def test_the_screen_and_the_archive_list_name_variables_of_a_record():
    screen = (ROOT / "deploy" / "epics" / "motor.bob").read_text()
    archived = (ROOT / "deploy" / "epics" / "archiver.txt").read_text()
    fields = set(re.findall(r"\$\(M\)([.:]\w+)", screen)) | set(re.findall(r"(?m)^lab:x([.:]\w+),", archived))
    page = (ROOT / "docs" / "how-to" / "use-epics.md").read_text()

    assert len(fields) > 10
    assert [field for field in fields if not re.search(rf"\b{field[1:]}\b", page)] == []
