"""A model and its bank as one module: images in, descriptors out, each image beside the bank and beside no other."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from pipeline.model.bank import Bank
from pipeline.model.cross_image import Memory
from pipeline.model.vpr import PlaceModel


class BesideBank(nn.Module):
    """images [b, 3, H, W], ImageNet-normalised -> descriptors [b, R*D]; in eval mode. The bank's keys and values are
    buffers, so they move and are exported with the module.

    Attributes:
        model: the model itself; `config`, `image_size`, `input_size` and `descriptor_dim` are its own.

    Raises:
        UsageError: a model or a bank that does not fit (`PlaceModel.remember`).
    """

    def __init__(self, model: PlaceModel, bank: Bank) -> None:
        super().__init__()
        self.model, self.bank = model.eval(), bank
        self.config, self.image_size, self.input_size = model.config, model.image_size, model.input_size
        self.descriptor_dim = model.descriptor_dim
        self.layers = len(model.cross_image.layers)
        for number, (keys, values) in enumerate(model.remember(bank)):
            self.register_buffer(f"keys{number}", keys.detach(), persistent=False)
            self.register_buffer(f"values{number}", values.detach(), persistent=False)

    def memory(self) -> Memory:
        """Keys and values of each layer."""
        held: Any = self._buffers
        return [(held[f"keys{number}"], held[f"values{number}"]) for number in range(self.layers)]

    def forward(self, images: Tensor) -> Tensor:
        """[b, 3, H, W] -> [b, R*D], of unit length."""
        return self.model.correlate_beside(self.model.encode(images), self.memory())
