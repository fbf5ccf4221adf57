"""What griffe does not know of records: the parameters of NamedTuples and sections, and defaults of _bounded."""

from typing import Any

from griffe import Attribute, Class, ExprCall, Extension, Function, Parameter, ParameterKind, Parameters


class Records(Extension):
    """Show the fields of records as the parameters that they are."""

    def on_attribute_instance(self, *, attr: Attribute, **_: Any) -> None:
        """Take a field's default out of the call that makes it."""
        if isinstance(attr.value, ExprCall) and attr.value.canonical_name == "_bounded":
            attr.value = attr.value.arguments[0]

    def on_class_members(self, *, cls: Class, **_: Any) -> None:
        """Give a NamedTuple, or a section of the configuration, the constructor that it has."""
        if not {"NamedTuple", "Section"} & {str(base) for base in cls.bases}:
            return
        fields = [field for field in cls.attributes.values() if "property" not in field.labels]
        kind = ParameterKind.positional_or_keyword
        own = [Parameter(f.name, annotation=f.annotation, kind=kind, default=f.value) for f in fields]
        cls.set_member("__init__", Function("__init__", parameters=Parameters(Parameter("self", kind=kind), *own)))
