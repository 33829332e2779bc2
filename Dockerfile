# Training and evaluation in a container. On GPU hosts: docker run --gpus all --ipc host ...
# (the torch wheel brings its own CUDA runtime; DataLoader workers need --ipc host or a larger --shm-size)
FROM python:3.11-slim

ENV PIP_NO_CACHE_DIR=1 PYTHONUNBUFFERED=1
WORKDIR /app

# versions first: this layer is rebuilt only when they change
COPY pyproject.toml constraints.txt README.md ./
COPY shards shards
COPY pipeline pipeline
COPY jobs jobs
RUN pip install --upgrade "pip>=25" && pip install --constraint constraints.txt --editable ".[deepspeed]"

# data and runs live outside the image: -v /my/data:/app/data -v /my/outputs:/app/outputs
VOLUME ["/app/data", "/app/outputs"]
CMD ["python", "-m", "jobs.train", "--help"]
