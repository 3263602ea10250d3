"""Registry of quantities and tasks that are added from outside the package."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace

from rps_jax import errors
from rps_jax.robot.base import Odometry
from rps_jax.robot.robot import Robot
from rps_jax.robot.skin import CapacitiveSkin
from rps_jax.world import domain, tasks
from rps_jax.world.quantity import Quantity, claim, declared
from rps_jax.world.tasks.base import Task


def register_quantity(name: str, quantity: Quantity) -> None:
    """Register a quantity that domains draw if they have a range of this name.

    A domain has the range as `wide,NAME=LOW:HIGH`, or as `Domain(custom={NAME: Range(LOW, HIGH)})`.
    In a world it sets the field of this name of the skin or of the odometry (owner `base`), or of
    the robot (`robot_NAME`); of another owner, `quantity.apply` says what it sets. Its random
    numbers are a stream of their own, so that no other quantity changes.

    Args:
      name: name of the quantity.
      quantity: unit, meaning, limits and owner.

    Raises:
      InputError: another quantity, number or field has this name, or the owner has no such field.

    Examples:
      >>> from rps_jax import Domain, Quantity, Range, register_quantity
      >>> threshold = Quantity("1", "threshold of the skin", ge=0.05, le=1, owner="skin")
      >>> register_quantity("threshold", threshold)
      >>> Domain(custom={"threshold": Range(0.1, 0.5)}).range_of("threshold")
      Range(low=0.1, high=0.5, log=False)
    """
    known = domain.QUANTITIES.get(name)
    claim("a custom quantity", name)
    if known is not None and replace(known, apply=quantity.apply) != quantity:
        rule = f"it is registered as {known}; choose another name"
        raise errors.not_allowed("name of a quantity", name, rule)
    if quantity.numbers is not None:
        rule = "its random number has its own name; leave numbers out"
        raise errors.not_allowed(f"numbers of the quantity {name}", quantity.numbers, rule)
    if quantity.apply is None and quantity.owner not in ("skin", "base", "robot"):
        rule = "without a function `apply` it sets nothing; give one"
        raise errors.not_allowed(f"owner of the quantity {name}", quantity.owner, rule)
    targets = {"skin": CapacitiveSkin._fields, "base": Odometry._fields}
    if quantity.owner in targets and quantity.apply is None:
        errors.check_name(f"quantity of the {quantity.owner}", name, targets[quantity.owner])
    if quantity.owner == "robot" and quantity.apply is None:
        used = {domain.robot_field(x) for x in domain.quantities_of("robot") if x != name}
        free = [x.name for x in fields(Robot) if x.name not in {*used, "boards"}]
        errors.check_name("quantity of the robot", name, [f"robot_{x}" for x in free])
    domain.REGISTERED.add(name)
    _publish({name: quantity})
    if quantity.owner == "object":
        domain.OBJECT_QUANTITIES.add(name)


def register_task(task: type[Task]) -> None:
    """Register a class of tasks, to be named by its `kind`, as `--task KIND`.

    It replaces a registered class of this kind. Each of its drawn quantities and `NUMBERS` has its
    own stream of random numbers, except for those that it inherits.

    Args:
      task: frozen dataclass that extends `Task`; see `world/tasks/base.py`.

    Raises:
      InputError: it is no such class, its kind is a task of this package, or another task, domain
        or object has the name of one of its quantities, numbers or outcomes.

    Examples:
      >>> from dataclasses import dataclass
      >>> from rps_jax import Domain, register_task
      >>> from rps_jax.world.tasks.reach import Reach
      >>> @dataclass(frozen=True)
      ... class Arrive(Reach):
      ...     kind: str = "arrive"
      >>> register_task(Arrive)
      >>> Domain(task=Arrive()).task.kind
      'arrive'
    """
    if not (isinstance(task, type) and issubclass(task, Task) and is_dataclass(task)):
        raise errors.not_allowed("task", repr(task), "give a dataclass that extends Task")
    if not task.kind or task.kind in tasks.PACKAGE_TASKS:
        rule = f"choose another one than {', '.join(tasks.PACKAGE_TASKS)}"
        raise errors.not_allowed(f"kind of the task {task.__name__}", repr(task.kind), rule)
    tasks.add(task)
    _publish(declared(task))


def _publish(quantities: Mapping[str, Quantity]) -> None:
    """Add quantities to those of all domains, and to the columns of reports."""
    domain.QUANTITIES.update(quantities)
    domain.LABELS.update({name: x.about for name, x in quantities.items() if x.reported})
