"""Several plans of one task, side by side."""

from dataclasses import dataclass

from planners.certify import certify


@dataclass(frozen=True)
class Table:
    """One row per plan; str() prints it."""

    rows: tuple[dict, ...]

    def __str__(self) -> str:
        names = list(self.rows[0]) if self.rows else []
        cells = [names, *([f"{x:.6g}" if isinstance(x, float) else str(x) for x in row.values()] for row in self.rows)]
        widths = [max(len(row[k]) for row in cells) for k in range(len(names))]
        return "\n".join("  ".join(x.rjust(w) for x, w in zip(row, widths, strict=True)) for row in cells)


def compare(task, plans) -> Table:
    """Cost, time, size and certificate of several plans, each certified again for this task."""
    return Table(tuple(_row(task, plan) for plan in plans))


def _row(task, plan):
    certificate = certify(task, plan)
    return {
        "solver": plan.info["options"]["solver"],
        "accuracy": plan.info["options"]["accuracy"],
        "status": plan.status,
        "certified": certificate.passed,
        "cost": float(plan.info["cost"]),
        "duration_s": float(plan.phases[-1].times[-1]),
        "iterations": int(plan.history[-1][0]),
        "solve_s": float(plan.timing["solve_s"]),
        "compile_s": float(plan.timing["compile_s"]),
    }
