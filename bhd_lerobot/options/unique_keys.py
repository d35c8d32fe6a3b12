"""A loader of YAML that takes nothing for something else: a key that is there twice, a date."""

from typing import Any

import yaml


class UniqueKeys(yaml.SafeLoader):
    """Reads a date as text, and refuses a key that a mapping has twice, of which YAML would take the last."""

    def flatten_mapping(self, node: Any) -> None:
        """Check the keys as they are written; what `<<` merges into them afterwards gives way to them."""
        if not hasattr(node, "has_own_keys"):
            keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
            for key in (key for key in keys if keys.count(key) > 1):
                place = f"line {node.start_mark.line + 1}"
                raise yaml.YAMLError(
                    f"the key {key!r} occurs twice in the mapping that begins in {place}; leave one of them"
                )
            node.has_own_keys = True
        super().flatten_mapping(node)


UniqueKeys.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in kinds if tag != "tag:yaml.org,2002:timestamp"]
    for first, kinds in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
