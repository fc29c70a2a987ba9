import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldcnd.client.traces import Trace, load_trace, require_suffix, save_trace
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.samples import Quality
from ldcnd.contract.traces import TraceChannel, TraceHeader, TracePhase, TraceSource

HEADER = TraceHeader(
    t=1_700_000_000_000_000_000,
    t_error_ns=12,
    seq=3,
    quality=Quality.GOOD,
    trace_id="a-1",
    axis="x",
    source=TraceSource.HOST,
    phase=TracePhase.COMPLETE,
    channels=(
        TraceChannel(name="position", unit="mm", raw_column=0),
        TraceChannel(name="enabled", unit="", raw_column=1),
    ),
    interval_s=0.001,
    samples=2,
    pre_trigger=0,
    chunks=1,
    raw_columns=("position of the drive", "a name, with a comma"),
)
TRACE = Trace(HEADER, (-5, 10), ((1.25, None), (0.0, 1.0)), ((1250, 0.5), (0, None)))


@pytest.mark.parametrize("name", ["trace.csv", "trace.json"])
def test_a_file_gives_back_what_was_saved(tmp_path, name):
    save_trace(TRACE, tmp_path / name)

    loaded = load_trace(tmp_path / name)

    assert loaded == TRACE
    assert [[type(value) for value in column] for column in loaded.raw] == [[int, float], [int, type(None)]]


FINITE = st.floats(allow_nan=False, allow_infinity=False)


@given(
    rows=st.lists(
        st.tuples(st.integers(), FINITE | st.none(), FINITE, st.integers() | FINITE, st.integers()), min_size=1
    ),
    suffix=st.sampled_from(["csv", "json"]),
)
def test_any_numbers_survive_both_formats(tmp_path_factory, rows, suffix):
    offsets, first, second, counts, words = zip(*rows, strict=True)
    trace = Trace(HEADER, offsets, (first, second), (counts, words))
    path = tmp_path_factory.mktemp("trace") / f"trace.{suffix}"

    save_trace(trace, path)

    assert load_trace(path) == trace


def test_csv_names_its_columns_with_units(tmp_path):
    save_trace(TRACE, tmp_path / "trace.csv")

    _, titles, first, *_ = (tmp_path / "trace.csv").read_text().splitlines()

    assert titles == 'offset_ns,position [mm],enabled,position of the drive,"a name, with a comma"'
    assert first == "-5,1.25,0.0,1250,0"


@pytest.mark.parametrize(
    "text",
    ["", "{}", "# ldcnd trace {}\na\n1\n", "\x00", f"# ldcnd trace {HEADER.model_dump_json()}\ntitles\n1,2\n"],
)
def test_what_is_no_trace_is_refused_in_one_line(tmp_path, text):
    path = tmp_path / "bad.csv"
    path.write_text(text)

    with pytest.raises(ConfigError, match="not a trace") as refused:
        load_trace(path)

    assert "\n" not in refused.value.message


def test_name_must_tell_the_format(tmp_path):
    with pytest.raises(ConfigError, match=r"\.json or \.csv"):
        require_suffix(tmp_path / "trace.txt")


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        load_trace(tmp_path / "none.csv")
