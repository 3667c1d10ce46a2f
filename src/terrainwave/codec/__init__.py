"""Codecs: conversion of one group of heights to a payload and back."""
