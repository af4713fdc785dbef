# Installs when it is built, so that running it needs no network. docker build -t clpipe . does it;
# git archive HEAD | docker build -t clpipe - lets clpipe --version name the commit, too.
FROM python:3.12-slim
RUN apt-get update && apt-get install --yes --no-install-recommends binutils
WORKDIR /clpipe
COPY . .
RUN sh tools/setup
CMD ["sh", "tools/demo", "/demo"]
