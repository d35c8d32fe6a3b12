"""What a brain is asked for on a table: what is there, what is not, and what is there several times."""

import numpy as np

from benchmarks.refusals import questions
from bhd_lerobot.policies.language.grounding import fitting
from bhd_lerobot.policies.language.instruction import parse
from bhd_lerobot.policies.manipulation.skills import SceneObject
from bhd_lerobot.tasks.pick import PickConfig, PickTask


def test_each_question_fits_as_many_objects_as_its_kind_says() -> None:
    task, asked = PickTask(PickConfig(), 1, 25), {"there": 0, "absent": 0, "several": 0}
    for seed in range(200):
        scene = task.sample(seed)
        objects = [SceneObject.from_table(number, one) for number, one in enumerate(scene.objects)]
        for kind, name in questions(scene, np.random.default_rng(seed)).items():
            found = fitting(parse(f"pick up the {name}").what, objects)
            asked[kind] += 1
            assert {"there": len(found) == 1, "absent": not found, "several": len(found) > 1}[kind], (seed, kind, name)
            if kind == "there":
                assert found[0].index == scene.target_object
    assert min(asked.values()) > 50
