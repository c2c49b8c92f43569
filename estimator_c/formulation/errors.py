"""What the generator says when its inputs are unusable."""


class FormulationError(ValueError):
    """Unusable weights or settings: one line with the file, the field and what to do."""

    def __init__(self, path: object, field: str, problem: str, remedy: str) -> None:
        self.path, self.field, self.problem, self.remedy = str(path), field, problem, remedy
        super().__init__(f"{path}: {field}: {problem}; {remedy}")
