"""What learns from touches: each module is one choice of ``learner=``."""
