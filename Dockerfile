# docker build -t crazyarena . && docker run --rm crazyarena dry-run --level level3
FROM python:3.12-slim
RUN apt-get update && apt-get install -y --no-install-recommends bubblewrap make && rm -rf /var/lib/apt/lists/*
COPY . /src
RUN python -m pip install --no-cache-dir "/src[mocap,symbolic]" && rm -rf /src
RUN useradd --create-home pilot
USER pilot
WORKDIR /home/pilot
RUN crazyarena warm-up
ENTRYPOINT ["crazyarena"]
CMD ["dry-run"]
