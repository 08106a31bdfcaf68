"""The same sheet in PyNite: the referee of the plates-and-beams model.

PyNite is a development dependency, imported on use.
"""

from typing import TYPE_CHECKING

import numpy as np

from skin.body.material import Material
from skin.mechanics.simulator.fem import Structure

if TYPE_CHECKING:
    from Pynite import FEModel3D


def model(structure: Structure, pressure: np.ndarray) -> "FEModel3D":
    """Return a PyNite model of a sheet under pressure (H, W), Pa, ready to be analysed.

    Nodes are called ``interface,row,column``, with interface 0 on the table; z runs up from the table.
    """
    from Pynite import FEModel3D

    body = structure.body
    built = FEModel3D()
    _add_nodes(built, structure)
    for number, layer in enumerate(body.layers, start=1):
        _add_beams(built, structure, number)
        for row, column in np.ndindex(body.shape):
            corners = [(row, column), (row, column + 1), (row + 1, column + 1), (row + 1, column)]
            names = [f"{number},{j},{i}" for j, i in corners]
            name = f"{number},{row},{column}"
            material = _add_material(built, f"plate {name}", layer.material)
            built.add_plate(name, *names, layer.thickness, material)
    for (row, column), value in np.ndenumerate(pressure):
        if value:
            built.add_plate_surface_pressure(f"{len(body.layers)},{row},{column}", -float(value))
    return built


def solve(built: "FEModel3D") -> None:
    built.analyze_linear(check_stability=False)


def displacements(built: "FEModel3D", structure: Structure) -> np.ndarray:
    """Return what each node above the table does, (layers, ny + 1, nx + 1, 6): m and rad, z upwards."""
    answer = np.zeros((*structure.grid, 6))
    for level, row, column in np.ndindex(structure.grid):
        node = built.nodes[f"{level + 1},{row},{column}"]
        for dof, name in enumerate(("DX", "DY", "DZ", "RX", "RY", "RZ")):
            answer[level, row, column, dof] = getattr(node, name)["Combo 1"]
    return answer


def _add_nodes(built: "FEModel3D", structure: Structure) -> None:
    body = structure.body
    heights = [0.0, *(body.thickness - depth for depth in body.interfaces)]
    for level, height in enumerate(heights):
        held = [level == 0 or dof not in structure.free for dof in range(6)]
        for row, column in np.ndindex(structure.grid[1:]):
            name = f"{level},{row},{column}"
            built.add_node(name, column * body.cell[0], row * body.cell[1], height)
            built.def_support(name, *held)


def _add_material(built: "FEModel3D", name: str, material: Material) -> str:
    built.add_material(name, material.young, material.shear, material.poisson, rho=1.0)
    return name


def _add_beams(built: "FEModel3D", structure: Structure, number: int) -> None:
    """Join each node of an interface to the one below by the part of the sheet nearest to it."""
    body, layer = structure.body, structure.body.layers[number - 1]
    rows, columns = structure.grid[1:]
    for row, column in np.ndindex(rows, columns):
        width = body.cell[0] * (0.5 if column in {0, columns - 1} else 1)
        height = body.cell[1] * (0.5 if row in {0, rows - 1} else 1)
        second_y, second_x = width * height**3 / 12, height * width**3 / 12
        name = f"{number},{row},{column}"
        material = _add_material(built, f"beam {name}", layer.material)
        built.add_section(name, width * height, second_y, second_x, second_y + second_x)
        built.add_member(name, f"{number - 1},{row},{column}", name, material, name)
