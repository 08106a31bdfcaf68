"""
Write the training loop yourself
================================

``skin.data`` gives the batches of a training to a plain torch loop. Its settings are those of ``skin train``:
an option by the name of its group, and the settings of a group as a mapping.
"""

import torch

import skin

# %%
# A pass is an epoch
# ------------------
# With ``fresh``, each pass draws new gestures. A repeated script sees the same ones: they depend on the seed
# and the number of the pass. ``frames.x`` has the readings of 30 frames.

data = skin.data(simulator="naive", representation="readings", data={"gestures": 400, "fresh": True}, seed=1)
inputs = data.example.readings[0].numel()
layers = [torch.nn.Flatten(), torch.nn.Linear(inputs, 64), torch.nn.ReLU(), torch.nn.Linear(64, 4)]
network = torch.nn.Sequential(*layers)
optimizer, loss_of = torch.optim.Adam(network.parameters(), lr=3e-3), torch.nn.BCEWithLogitsLoss()
for _ in range(5):
    for frames, labels in data.train_dataloader():
        loss = loss_of(network(frames.x), labels)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

# %%
# Validate it
# -----------
# Validation gestures are the same in each pass.

with torch.no_grad():
    right = [(network(frames.x) > 0) == (labels > 0.5) for frames, labels in data.val_dataloader()]
print(dict(zip(data.task.names, torch.cat(right).double().mean(dim=0).tolist(), strict=True)))
