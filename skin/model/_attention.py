"""The transformer encoder that models and heads over time share."""

from torch import nn

from skin.errors import InputError


def encoder(
    width: int, heads: int, layers: int, feedforward: int, dropout: float, setting: str
) -> nn.TransformerEncoder:
    """Return layers of self-attention (Vaswani et al., 2017) on (N, tokens, width), normed before each part.

    Normed before (Xiong et al., 2020), so that it trains with Adam at 1e-3 without a warm-up.

    Args:
        width: of a token.
        heads: of attention in each layer; they share the width.
        layers: their number.
        feedforward: width of the hidden layer in each of them.
        dropout: share of values dropped in training.
        setting: the override that sets the width, named where it does not fit.

    Raises:
        InputError: a width that the heads cannot share.
    """
    if width % heads:
        raise InputError(
            f"{heads} heads of attention must share the width equally, got {setting}={width}: "
            f"set {setting}={-(-width // heads) * heads}"
        )
    layer = nn.TransformerEncoderLayer(
        width, heads, feedforward, dropout, activation="gelu", batch_first=True, norm_first=True
    )
    result = nn.TransformerEncoder(layer, layers, nn.LayerNorm(width), enable_nested_tensor=False)
    for parameter in result.parameters():
        if parameter.ndim > 1:  # torch copies the first layer: without this all would start the same
            nn.init.xavier_uniform_(parameter)
    return result
