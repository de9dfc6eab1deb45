"""`calibration.json`: every number comes back, and a damaged file is named."""

axis = hnp.arrays(np.float64, 3, elements=st.floats(-1, 1)).filter(
    lambda v: np.linalg.norm(v) > 1e-3
)
angles = st.one_of(
    st.floats(-math.pi, math.pi),
    st.sampled_from([0.0, math.pi, math.pi / 2, -math.pi / 2, 1e-17, 1e-9, math.pi - 1e-9]),
)


@st.composite
def transforms(draw: st.DrawFn) -> Array:
    """Return rigid transforms, among them turns by 0, 90 and 180 deg about the axes."""
    w = draw(st.one_of(axis, st.sampled_from([np.eye(3)[k] for k in range(3)])))
    R = se3.exp_so3(w / np.linalg.norm(w) * draw(angles))
    if draw(st.booleans()):
        R = se3.from_rt([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], np.zeros(3))[:3, :3] @ R
    t = [draw(st.floats(-2, 2)) for _ in range(3)]
    return se3.from_rt(R, t)



@given(X=transforms(), seed=st.integers(0, 11), target=st.sampled_from(TARGETS))
@settings(max_examples=25, deadline=None)
def test_json_round_trip_is_exact(
    X: Array, seed: int, target: Target, tmp_path_factory: pytest.TempPathFactory
) -> None:
    mode: Mode = "eye_in_hand" if seed % 2 else "eye_to_hand"
    report = make_report(X, mode, target, seed)
    path = tmp_path_factory.mktemp("json") / "calibration.json"
    path.write_text(calibration_text(report, FRAMES), encoding="utf-8")
    again = read_calibration(path)
    assert type(again.target) is type(report.target)
    assert calibration_text(again, FRAMES) == path.read_text(encoding="utf-8")
    assert_same_record(report, again)


def assert_same_record(a: Any, b: Any) -> None:
    """Compare dataclasses field by field; a rotation may be made orthonormal within 1e-12."""
    assert type(a) is type(b)
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if dataclasses.is_dataclass(x):
            assert_same_record(x, y)
        elif isinstance(x, np.ndarray):
            np.testing.assert_allclose(y, x, rtol=0, atol=1e-12, err_msg=field.name)
            assert y.shape == x.shape
        elif isinstance(x, tuple) and x and dataclasses.is_dataclass(x[0]):
            for u, v in zip(x, y, strict=True):
                assert_same_record(u, v)
        elif isinstance(x, float) and math.isnan(x):
            assert math.isnan(y)
        else:
            assert x == y, field.name


def damaged(key: str, value: Any, drop: bool = False) -> str:
    document = json.loads(calibration_text(make_report(np.eye(4)), FRAMES))
    at = document
    *way, last = key.split("/")
    for step in way:
        at = at[int(step) if step.isdigit() else step]
    if drop:
        del at[last]
    else:
        at[last] = value
    return json.dumps(document)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "cannot be read as JSON"),
        ("[1, 2]", "schema"),
        (damaged("schema", "other"), "schema 'other'"),
        (damaged("version", 99), "version 99"),
        (damaged("mode", "sideways"), "sideways"),
        (damaged("X", None, drop=True), "'X' is missing"),
        (damaged("X/covariance", [[1.0]]), "shape"),
        (damaged("X/quaternion_xyzw", [1.0, 0.0, 0.0, 0.0]), "different transforms"),
        (damaged("X_alone/translation_m", [0.0, 0.0, 5.0]), "different transforms"),
        (damaged("views/2/uv", [[1.0, "x"]]), "'uv' cannot be used"),
        (damaged("views/0/index", None), "whole number"),
        (damaged("views", 3), "list of named entries"),
        (damaged("target/rows", None, drop=True), "does not fit"),
        (damaged("target/type", "Egg"), "Egg"),
        (damaged("checks/0/verdict", "superb"), "superb"),
        (damaged("robot_map/kind", "odd"), "odd"),
        (damaged("robot_map/frame", "odd"), "odd"),
        (damaged("map_scores", [["none"]]), "names and numbers"),
    ],
)
def test_a_damaged_file_is_named(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"calibration\.json") as error:
        read_calibration(path)
    assert says in str(error.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_calibration(tmp_path / "none.json")
