"""No file imports another that imports it by any way; imports for types alone do not count."""

import grimp


def test_no_file_of_the_four_packages_imports_itself_by_a_circle() -> None:
    graph = grimp.build_graph(
        "realsim", "realsim_calibration", "realsim_capture_plans", "realsim_sim_bridge",
        exclude_type_checking_imports=True,
    )  # fmt: skip
    left = {m: graph.find_modules_directly_imported_by(m) for m in graph.modules}
    # What imports nothing that is left is in no circle; take it away until nothing more goes.
    while free := {m for m, imported in left.items() if not imported & left.keys()}:
        left = {m: imported for m, imported in left.items() if m not in free}
    # The same from the other side: what nobody left imports.
    while ends := left.keys() - set().union(*left.values()):
        left = {m: imported for m, imported in left.items() if m not in ends}
    assert not left, {m: sorted(imported & left.keys()) for m, imported in left.items()}
