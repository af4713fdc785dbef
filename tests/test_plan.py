"""The planner: pure, so it is tested without a device."""

import pytest

from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.bindings import EncodedCurves
from clpipe.engine.codegen import write_kernel
from clpipe.engine.ir import Finalize, Launch, Lines, Reduce
from clpipe.engine.plan import make_plan
from clpipe.engine.traffic import bytes_per_pixel

GRAY_WORLD = {"white_balance": {"method": "gray_world"}}


def plan_of(keep=(), fold=True, final=False, encode=True, **settings):
    return make_plan(
        make_chain(settings_from(settings)), keep=keep, fold=fold, final=final, encode=encode
    )


def names(plan):
    return [launch.name for launch in plan.launches]


def test_default_chain():
    assert names(plan_of()) == [
        "lines",
        "inverse_color_matrix",
        "optical_blur.blur..demosaic",
        "demosaic.bounded_green",
        "demosaic.bounded_red_and_blue..denoise",
        "denoise.biweight..sharpen",
        "sharpen.unsharp..gamma",
    ]


def test_default_chain_with_gray_world_is_ten_launches_and_at_most_48_bytes():
    plan = plan_of(**GRAY_WORLD)
    kinds = [Lines, Launch, Launch, Reduce, Finalize, *[Launch] * 5]
    assert [type(launch) for launch in plan.launches] == kinds
    assert bytes_per_pixel(plan, 8) <= 48


def test_gains_estimated_from_the_image_are_applied_where_the_stencil_reads():
    settings = {"demosaic": {"method": "edge_directed_median"}, **GRAY_WORLD}
    plan = plan_of(**settings)
    prologues = [
        [op.step for read in launch.reads for op in read.prologue]
        for launch in plan.launches
        if isinstance(launch, Launch)
    ]
    assert prologues == [[], [], ["white_balance"], [], ["white_balance"], [], []]
    unfolded = plan_of(fold=False, **settings)
    assert "white_balance" in names(unfolded)


def test_keeping_a_stage_inside_a_group_splits_it():
    plain, kept = plan_of(), plan_of(keep=("sensor_noise",))
    assert len(kept.launches) == len(plain.launches) + 1
    assert names(kept)[2:4] == ["optical_blur.blur..sensor_noise", "row_noise..demosaic"]
    assert [name for name, _ in kept.kept] == ["sensor_noise"]


def test_keeping_a_stage_at_the_end_of_a_group_costs_no_launch_but_a_slot():
    bilinear = {"demosaic": {"method": "bilinear"}}  # the default begins with a pointwise pass
    plain, kept = plan_of(**bilinear), plan_of(keep=("white_balance",), **bilinear)
    assert len(kept.launches) == len(plain.launches)
    assert [name for name, _ in kept.kept] == ["white_balance"]


@pytest.mark.parametrize(
    ("method", "launches"),
    [({"method": "bilinear"}, 1), ({"method": "edge_directed_median", "size": 5}, 3)],
)
def test_demosaicing_takes_so_many_launches(method, launches):
    plan = plan_of(stages=["mosaic", "demosaic"], demosaic=method)
    own = [x for x in plan.launches if isinstance(x, Launch) and x.stencil]
    assert len(own) == launches


def functions(plan):
    return [op.pass_.function for x in plan.launches if isinstance(x, Launch) for op in x.ops]


def test_denoising_goes_on_from_the_roots_that_demosaicing_has():
    assert not {"roots_to_light", "light_to_roots"} & set(functions(plan_of()))
    apart = functions(plan_of(denoise={"offset": 0.02}))
    assert apart.index("light_to_roots") == apart.index("roots_to_light") + 1
    assert functions(plan_of(keep=("demosaic",))) == apart


def test_a_plan_depends_on_structure_alone():
    one, two = plan_of(iso=100), plan_of(iso=3200, exposure={"ev": 1}, seed=7)
    assert one == two
    assert hash(one) == hash(two)
    assert one != plan_of(mosaic={"pattern": "BGGR"})
    assert one != plan_of(sharpen={"radius": 3})


def test_the_border_is_as_wide_as_the_widest_stencil():
    assert plan_of().border == 2
    assert plan_of(denoise={"chroma_scale": 4}).border == 4
    assert plan_of(skip=["denoise"]).border == 2
    assert plan_of(denoise={"method": "mean", "chroma_size": 13}).border == 6
    assert plan_of(stages=["exposure", "gamma"]).border == 0


def curves_of(kernel):
    bindings = (parameter.binding for parameter in kernel.parameters)
    return [each.steps for each in bindings if isinstance(each, EncodedCurves)]


def test_curves_before_eight_bits_become_one_table():
    curve = {"tone_curve": {"method": "camera_raw"}}
    plan = plan_of(**curve)
    kernel = write_kernel(plan, plan.launches[-1], 8)
    assert curves_of(kernel) == [("tone_curve", "gamma")]
    kept = plan_of(keep=("tone_curve",), **curve)
    kernel = write_kernel(kept, kept.launches[-1], 8)
    assert curves_of(kernel) == [("gamma",)]


def texts(plan):
    return {write_kernel(plan, launch, 8).source for launch in plan.launches}


CHAINS = {
    "default": {},
    "white_patch": {"white_balance": {"method": "white_patch"}},
    "slow": {"demosaic": {"method": "menon2007"}, "denoise": {"method": "non_local_means"}},
}


@pytest.mark.parametrize("settings", CHAINS.values(), ids=CHAINS)
def test_keeping_a_stage_compiles_at_most_the_two_halves_of_its_launch(settings):
    warm = texts(plan_of(**settings))
    for step in make_chain(settings_from(settings)).steps:
        kept = plan_of(keep=(step.name,), **settings)
        assert len(texts(kept) - warm) <= 2, step.name


def test_a_kernel_does_not_depend_on_names_slots_places_or_the_border():
    def blur(plan, number):
        """The launches of the number-th denoise stage, which reads and writes RGB planes."""
        launches = [x for x in plan.launches if isinstance(x, Launch) and x.stencil]
        return write_kernel(plan, launches[number], 8)

    alike = {"stages": ["exposure", "denoise", "denoise", "denoise", "color_matrix"]}
    own = {"method": "mean", "luma_size": 5, "chroma_size": 5}
    plain = plan_of(**alike, denoise=own, denoise_2=own, denoise_3=own, encode=False, final=True)
    first, second = blur(plain, 0), blur(plain, 1)
    assert first.source == second.source
    assert first.name == second.name
    assert first.parameters != second.parameters  # they are bound to other slots and steps
    wide = {**own, "chroma_size": 11}
    other = plan_of(**alike, denoise=own, denoise_2=own, denoise_3=wide, encode=False, final=True)
    assert other.border > plain.border
    assert blur(other, 0).source == first.source


def test_numbers_that_numpy_computed_are_written_as_numbers(clpipe):
    """NumPy writes its own floats with their type, which TOML does not read."""
    text = clpipe("plan", "--toml", "--iso", "3200").stdout
    assert "\n# luma_noise = 0.0" in text and "np." not in text
