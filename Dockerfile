# All jobs in a container, as a user that is not root. The first word is the job:
#   docker build -t place-recognition .                # for GPUs: torch's wheel brings its own CUDA runtime
#   docker run --rm place-recognition health           # what this container has: processors, GPUs, memory, writable folders
#   docker run --rm place-recognition demo
#   docker run --gpus all --shm-size 8g -v /my/data:/app/data -v /my/outputs:/app/outputs place-recognition \
#       train --config jobs/configs/cricavpr.yaml --processes 8
# The folders of data and outputs must belong to user UID (1000), or give --user "$(id -u):$(id -g)".
FROM python:3.11-slim

ENV PIP_NO_CACHE_DIR=1 PYTHONUNBUFFERED=1 HOME=/tmp
WORKDIR /app

# any user may write here, also one of --user; what is mounted over them has the rights of the mounted folder
ARG UID=1000
RUN useradd --uid "$UID" --no-create-home --home-dir /tmp trainer \
    && mkdir -p data outputs && chown trainer data outputs && chmod 1777 data outputs

COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY shards shards
COPY pipeline pipeline
COPY jobs jobs
RUN pip install --upgrade "pip>=25" && pip install --constraint constraints.txt --editable ".[deepspeed]"

USER $UID
VOLUME ["/app/data", "/app/outputs"]
HEALTHCHECK --interval=5m --timeout=60s --start-period=1m CMD ["python", "-m", "jobs", "health"]
ENTRYPOINT ["python", "-m", "jobs"]
CMD ["--help"]
