"""Maps: from the DBC of any inverter to the samples that the estimator takes.

    from ipmsm_can.logs import read_log
    from ipmsm_can.mapping import load_map, mapped

    for block in mapped(read_log("run.blf"), load_map("cascadia_pm"), pole_pairs=4):
        ...                                   # MappedBlock: t_ns, i_alpha, i_beta, v_alpha, v_beta, quality, ...
"""

from ipmsm_can.mapping.load import MapError, load_map, parse_map, shipped_maps
from ipmsm_can.mapping.mapper import MappedBlock, Mapper, mapped
from ipmsm_can.mapping.model import InverterMap
from ipmsm_can.mapping.plan import Plan, make_plan

__all__ = ["InverterMap", "MapError", "MappedBlock", "Mapper", "Plan", "load_map", "make_plan", "mapped",
           "parse_map", "shipped_maps"]
